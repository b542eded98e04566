"""The conveyor world: a Panda above a belt that carries parts past it."""

from torchdyn_plan.envs.conveyor.env import ConveyorEnv
from torchdyn_plan.envs.conveyor.panda import panda_arm
from torchdyn_plan.envs.conveyor.scene import ConveyorScene

__all__ = ["ConveyorEnv", "ConveyorScene", "panda_arm"]
