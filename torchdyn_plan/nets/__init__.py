"""The two networks of the dynamic planner: where the target will be, and when the robot can be somewhere."""

from torchdyn_plan.nets.eta import Arrival, ETAConfig, ETANetwork
from torchdyn_plan.nets.forecaster import Forecaster, ForecasterConfig

__all__ = ["Arrival", "ETAConfig", "ETANetwork", "Forecaster", "ForecasterConfig"]
