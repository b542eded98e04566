"""Simulated worlds as TorchRL environments; each is imported on first use."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchdyn_plan.envs.arm_runner import ArmRunner, EnvRunner, FunctionRunner
    from torchdyn_plan.envs.episodes import draw_uniform
    from torchdyn_plan.envs.fetch_reach import DynamicReachEnv, FetchSimulation
    from torchdyn_plan.envs.moving_target import MovingTargetEnv, RobotReading
    from torchdyn_plan.envs.sensor import Sensor
    from torchdyn_plan.envs.trapper import TrapperEnv, TrapperGoalEnv, TrapperScene, TrapperSimulation

_PLACES = {
    "ArmRunner": "arm_runner",
    "DynamicReachEnv": "fetch_reach",
    "EnvRunner": "arm_runner",
    "FetchSimulation": "fetch_reach",
    "FunctionRunner": "arm_runner",
    "MovingTargetEnv": "moving_target",
    "RobotReading": "moving_target",
    "Sensor": "sensor",
    "TrapperEnv": "trapper",
    "TrapperGoalEnv": "trapper",
    "TrapperScene": "trapper",
    "TrapperSimulation": "trapper",
    "draw_uniform": "episodes",
}
"""Module of this folder that defines each name."""

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


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
