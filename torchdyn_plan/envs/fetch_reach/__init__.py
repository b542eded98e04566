"""Dynamic FetchReach's world: Fetch arms that reach for goals that move."""

from torchdyn_plan.envs.fetch_reach.arm_runner import FetchArmRunner
from torchdyn_plan.envs.fetch_reach.env import DynamicReachEnv
from torchdyn_plan.envs.fetch_reach.simulation import FetchSimulation

__all__ = ["DynamicReachEnv", "FetchArmRunner", "FetchSimulation"]
