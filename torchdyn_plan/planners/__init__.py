"""Planners: for a static goal, for a moving target, and the baselines; each takes and returns a tensordict."""

from torchdyn_plan.planners.adaptation import Adaptation
from torchdyn_plan.planners.background import Background, measured_latency
from torchdyn_plan.planners.baselines import OracleTrajectory, TargetPursuit, WaitAtEnd
from torchdyn_plan.planners.callable import CallablePlanner
from torchdyn_plan.planners.drop import Drop
from torchdyn_plan.planners.dynamic import STATIC_PLANNERS, DynamicPlanner
from torchdyn_plan.planners.exact import ExactSearch
from torchdyn_plan.planners.ik import IKPlanner
from torchdyn_plan.planners.meeting import MeetingPlanner
from torchdyn_plan.planners.policy import PolicyPlanner
from torchdyn_plan.planners.protocol import StaticPlanner
from torchdyn_plan.planners.schedule import EventSchedule, ReplanSchedule, Schedule
from torchdyn_plan.planners.search import CornerSearch, SearchResult, search_corners
from torchdyn_plan.planners.soft import SoftCornerSearch, SoftExactSearch
from torchdyn_plan.planners.status import PlanStatus

__all__ = [
    "STATIC_PLANNERS",
    "Adaptation",
    "Background",
    "CallablePlanner",
    "CornerSearch",
    "Drop",
    "DynamicPlanner",
    "EventSchedule",
    "ExactSearch",
    "IKPlanner",
    "MeetingPlanner",
    "OracleTrajectory",
    "PlanStatus",
    "PolicyPlanner",
    "ReplanSchedule",
    "Schedule",
    "SearchResult",
    "SoftCornerSearch",
    "SoftExactSearch",
    "StaticPlanner",
    "TargetPursuit",
    "WaitAtEnd",
    "measured_latency",
    "search_corners",
]
