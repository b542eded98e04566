"""The two networks of the dynamic planner: where the target will be, and when the robot can be somewhere."""

from torchdyn_plan.nets.forecaster import Forecaster, ForecasterConfig

__all__ = ["Forecaster", "ForecasterConfig"]
