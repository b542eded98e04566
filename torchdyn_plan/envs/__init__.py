"""Simulated worlds as TorchRL environments."""

from typing import TYPE_CHECKING

from torchdyn_plan.lazy import lazy_names

if TYPE_CHECKING:
    from torchdyn_plan.envs.arm_runner import ArmRunner, EnvRunner, FunctionRunner
    from torchdyn_plan.envs.episodes import draw_uniform
    from torchdyn_plan.envs.fetch_reach import DynamicReachEnv, FetchSimulation
    from torchdyn_plan.envs.moving_target import MovingTargetEnv, RobotReading
    from torchdyn_plan.envs.sensor import Sensor
    from torchdyn_plan.envs.trapper import TrapperEnv, TrapperGoalEnv, TrapperScene, TrapperSimulation

__all__ = [
    "ArmRunner",
    "DynamicReachEnv",
    "EnvRunner",
    "FetchSimulation",
    "FunctionRunner",
    "MovingTargetEnv",
    "RobotReading",
    "Sensor",
    "TrapperEnv",
    "TrapperGoalEnv",
    "TrapperScene",
    "TrapperSimulation",
    "draw_uniform",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "arm_runner": ("ArmRunner", "EnvRunner", "FunctionRunner"),
        "episodes": ("draw_uniform",),
        "fetch_reach": ("DynamicReachEnv", "FetchSimulation"),
        "moving_target": ("MovingTargetEnv", "RobotReading"),
        "sensor": ("Sensor",),
        "trapper": ("TrapperEnv", "TrapperGoalEnv", "TrapperScene", "TrapperSimulation"),
    },
)
