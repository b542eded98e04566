"""Where and when robot and target meet: interchangeable searches on a forecast."""

from torchdyn_plan.planners.search.corner import CornerSearch, search_corners
from torchdyn_plan.planners.search.exact import ExactSearch
from torchdyn_plan.planners.search.meeting import GoalSearch, Meeting, SearchContext
from torchdyn_plan.planners.search.soft import SoftCornerSearch, SoftExactSearch

__all__ = [
    "CornerSearch",
    "ExactSearch",
    "GoalSearch",
    "Meeting",
    "SearchContext",
    "SoftCornerSearch",
    "SoftExactSearch",
    "search_corners",
]
