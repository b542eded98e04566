"""Simulated tasks: MuJoCo scenes, batched simulation, TorchRL environments."""

from torchdyn_plan.envs.fetch import FetchSimulation
from torchdyn_plan.envs.goals import TrapperGoalEnv
from torchdyn_plan.envs.reach import DynamicReachEnv
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.simulation import TrapperSimulation
from torchdyn_plan.envs.trapper import TrapperEnv

__all__ = [
    "DynamicReachEnv",
    "FetchSimulation",
    "TrapperEnv",
    "TrapperGoalEnv",
    "TrapperScene",
    "TrapperSimulation",
]
