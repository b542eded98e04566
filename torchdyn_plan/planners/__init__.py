"""Planners for static goals and moving targets, and baselines; each takes and returns a tensordict."""

from typing import TYPE_CHECKING

from torchdyn_plan.lazy import lazy_names

if TYPE_CHECKING:
    from torchdyn_plan.planners.background import Background, measured_latency
    from torchdyn_plan.planners.baselines import (
        EndOfForecast,
        RecordedFuture,
        TargetPursuit,
        oracle_trajectory,
        wait_at_end,
    )
    from torchdyn_plan.planners.choice import ChoosingPlanner, Commits
    from torchdyn_plan.planners.delivery import Delayed, Delivery
    from torchdyn_plan.planners.maneuver import GoTo, Maneuver
    from torchdyn_plan.planners.match_velocity import MatchPhase, MatchVelocity
    from torchdyn_plan.planners.observation import Observation
    from torchdyn_plan.planners.pace_and_path import PaceAndPath
    from torchdyn_plan.planners.plan import Lost, LostBelow, MetWithin, Plan, PlanStatus
    from torchdyn_plan.planners.planner import DynamicPlanner, observe
    from torchdyn_plan.planners.pretrained import shipped_planners
    from torchdyn_plan.planners.protocol import StaticPlanner
    from torchdyn_plan.planners.schedule import EventSchedule, ReplanSchedule, Schedule
    from torchdyn_plan.planners.search import (
        CornerSearch,
        ExactSearch,
        GoalSearch,
        Meeting,
        SearchContext,
        SoftCornerSearch,
        SoftExactSearch,
        search_corners,
    )
    from torchdyn_plan.planners.static.approach import Approach, StraightToGoal, TurnedToGoal
    from torchdyn_plan.planners.static.callable import CallablePlanner
    from torchdyn_plan.planners.static.ik import IKPlanner
    from torchdyn_plan.planners.static.point import PointPlanner
    from torchdyn_plan.planners.static.policy import PolicyPlanner
    from torchdyn_plan.planners.static.proportional import ProportionalController
    from torchdyn_plan.planners.stay import GoAndStay
    from torchdyn_plan.planners.track import BallisticTrack, KalmanTrack, LeastSquaresTrack, Track, TrackState
    from torchdyn_plan.planners.tracked import TrackedPlanner
    from torchdyn_plan.planners.turn import AgainstVelocity, Turn, WithTarget

__all__ = [
    "AgainstVelocity",
    "Approach",
    "Background",
    "BallisticTrack",
    "CallablePlanner",
    "ChoosingPlanner",
    "Commits",
    "CornerSearch",
    "Delayed",
    "Delivery",
    "DynamicPlanner",
    "EndOfForecast",
    "EventSchedule",
    "ExactSearch",
    "GoAndStay",
    "GoTo",
    "GoalSearch",
    "IKPlanner",
    "KalmanTrack",
    "LeastSquaresTrack",
    "Lost",
    "LostBelow",
    "Maneuver",
    "MatchPhase",
    "MatchVelocity",
    "Meeting",
    "MetWithin",
    "Observation",
    "PaceAndPath",
    "Plan",
    "PlanStatus",
    "PointPlanner",
    "PolicyPlanner",
    "ProportionalController",
    "RecordedFuture",
    "ReplanSchedule",
    "Schedule",
    "SearchContext",
    "SoftCornerSearch",
    "SoftExactSearch",
    "StaticPlanner",
    "StraightToGoal",
    "TargetPursuit",
    "Track",
    "TrackState",
    "TrackedPlanner",
    "Turn",
    "TurnedToGoal",
    "WithTarget",
    "measured_latency",
    "observe",
    "oracle_trajectory",
    "search_corners",
    "shipped_planners",
    "wait_at_end",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "background": ("Background", "measured_latency"),
        "baselines": ("EndOfForecast", "RecordedFuture", "TargetPursuit", "oracle_trajectory", "wait_at_end"),
        "choice": ("ChoosingPlanner", "Commits"),
        "delivery": ("Delayed", "Delivery"),
        "maneuver": ("GoTo", "Maneuver"),
        "match_velocity": ("MatchPhase", "MatchVelocity"),
        "observation": ("Observation",),
        "pace_and_path": ("PaceAndPath",),
        "plan": ("Lost", "LostBelow", "MetWithin", "Plan", "PlanStatus"),
        "planner": ("DynamicPlanner", "observe"),
        "pretrained": ("shipped_planners",),
        "protocol": ("StaticPlanner",),
        "schedule": ("EventSchedule", "ReplanSchedule", "Schedule"),
        "search": (
            "CornerSearch",
            "ExactSearch",
            "GoalSearch",
            "Meeting",
            "SearchContext",
            "SoftCornerSearch",
            "SoftExactSearch",
            "search_corners",
        ),
        "static.approach": ("Approach", "StraightToGoal", "TurnedToGoal"),
        "static.callable": ("CallablePlanner",),
        "static.ik": ("IKPlanner",),
        "static.point": ("PointPlanner",),
        "static.policy": ("PolicyPlanner",),
        "static.proportional": ("ProportionalController",),
        "stay": ("GoAndStay",),
        "track": ("BallisticTrack", "KalmanTrack", "LeastSquaresTrack", "Track", "TrackState"),
        "tracked": ("TrackedPlanner",),
        "turn": ("AgainstVelocity", "Turn", "WithTarget"),
    },
)
