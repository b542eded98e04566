"""The world of catch: a UR10 with a cup, and balls that are thrown at it."""

from torchdyn_plan.envs.catch.env import CatchEnv
from torchdyn_plan.envs.catch.scene import CatchScene
from torchdyn_plan.envs.catch.ur10 import ur10_arm

__all__ = ["CatchEnv", "CatchScene", "ur10_arm"]
