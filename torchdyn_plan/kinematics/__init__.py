"""Arms as batched PyTorch: pose and Jacobian in closed form, damped least squares, inverse kinematics."""

from typing import TYPE_CHECKING

from torchdyn_plan.lazy import lazy_names

if TYPE_CHECKING:
    from torchdyn_plan.kinematics.arm import Arm
    from torchdyn_plan.kinematics.cartesian import ArmSolver
    from torchdyn_plan.kinematics.dls import dls_step, limited_step, square_turn, upright_error
    from torchdyn_plan.kinematics.fused import compiled_pose_and_jacobian
    from torchdyn_plan.kinematics.joint import Coupling, Joint
    from torchdyn_plan.kinematics.quaternions import quat_between, quat_matrix, quat_multiply
    from torchdyn_plan.kinematics.solver import IKResult, IKStatus, solve_ik
    from torchdyn_plan.kinematics.targets import constraint_error, constraint_jacobian, rotation_vector
    from torchdyn_plan.kinematics.trajectory import follow
    from torchdyn_plan.kinematics.ur5 import UR5_LINKS, UR5_SPEED_LIMIT, ur5_urdf
    from torchdyn_plan.kinematics.ur_branches import Branches, branches

__all__ = [
    "UR5_LINKS",
    "UR5_SPEED_LIMIT",
    "Arm",
    "ArmSolver",
    "Branches",
    "Coupling",
    "IKResult",
    "IKStatus",
    "Joint",
    "branches",
    "compiled_pose_and_jacobian",
    "constraint_error",
    "constraint_jacobian",
    "dls_step",
    "follow",
    "limited_step",
    "quat_between",
    "quat_matrix",
    "quat_multiply",
    "rotation_vector",
    "solve_ik",
    "square_turn",
    "upright_error",
    "ur5_urdf",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "arm": ("Arm",),
        "ur_branches": ("Branches", "branches"),
        "cartesian": ("ArmSolver",),
        "dls": ("dls_step", "limited_step", "square_turn", "upright_error"),
        "trajectory": ("follow",),
        "fused": ("compiled_pose_and_jacobian",),
        "joint": ("Coupling", "Joint"),
        "quaternions": ("quat_between", "quat_matrix", "quat_multiply"),
        "solver": ("IKResult", "IKStatus", "solve_ik"),
        "targets": ("constraint_error", "constraint_jacobian", "rotation_vector"),
        "ur5": ("UR5_LINKS", "UR5_SPEED_LIMIT", "ur5_urdf"),
    },
)
