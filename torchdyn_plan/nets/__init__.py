"""Networks: where the target will be, when the robot can be somewhere, and a policy that takes it there."""

from torchdyn_plan.nets.eta import Arrival, ETAConfig, ETANetwork
from torchdyn_plan.nets.forecaster import Forecaster, ForecasterConfig
from torchdyn_plan.nets.policy import Actor, Critic, PolicyConfig

__all__ = ["Actor", "Arrival", "Critic", "ETAConfig", "ETANetwork", "Forecaster", "ForecasterConfig", "PolicyConfig"]
