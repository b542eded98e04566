"""Networks: where the target will be, how sure that is, when the robot can be there, and a policy to take it there."""

from torchdyn_plan.nets.eta import Arrival, ETAConfig, ETANetwork
from torchdyn_plan.nets.forecaster import Forecaster, ForecasterConfig
from torchdyn_plan.nets.policy import Actor, Critic, PolicyConfig
from torchdyn_plan.nets.spread import Spread, SpreadConfig, SpreadNetwork

__all__ = [
    "Actor", "Arrival", "Critic", "ETAConfig", "ETANetwork", "Forecaster", "ForecasterConfig", "PolicyConfig", "Spread",
    "SpreadConfig", "SpreadNetwork",
]  # fmt: skip
