"""Arms as batched torch: pose and Jacobian in closed form, and the damped least squares that drives them."""

from torchdyn_plan.kinematics.arm import Arm
from torchdyn_plan.kinematics.dls import dls_step, limited_step, upright_error
from torchdyn_plan.kinematics.joint import Joint
from torchdyn_plan.kinematics.ur5 import UR5_LINKS, UR5_SPEED_LIMIT, ur5_urdf

__all__ = ["UR5_LINKS", "UR5_SPEED_LIMIT", "Arm", "Joint", "dls_step", "limited_step", "upright_error", "ur5_urdf"]
