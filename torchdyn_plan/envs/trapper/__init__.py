"""Trapper's world: a UR5 that drops a box over a rolling ball."""

from torchdyn_plan.envs.trapper.arm_runner import TrapperArmRunner
from torchdyn_plan.envs.trapper.env import TrapperEnv
from torchdyn_plan.envs.trapper.goal_env import TrapperGoalEnv
from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.envs.trapper.simulation import TrapperSimulation

__all__ = ["TrapperArmRunner", "TrapperEnv", "TrapperGoalEnv", "TrapperScene", "TrapperSimulation"]
