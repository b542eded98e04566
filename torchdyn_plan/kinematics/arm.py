"""A serial arm as batched torch: its pose and Jacobian in three tensor operations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_choice, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.trigonometric import Joint, trigonometric_form
from torchdyn_plan.kinematics.ur5 import UR5_SPEED_LIMIT, ur5_urdf

if TYPE_CHECKING:
    import pytorch_kinematics


class Arm(nn.Module):
    """A serial chain of N revolute joints, parsed by pytorch-kinematics and evaluated in closed form.

    The buffers ``lower``, ``upper`` (N,) [rad] and ``speed_limit`` (N,) [rad/s] hold the joints' limits.
    The number of sines grows with the number of non-parallel joints: 81 for a UR5, about a thousand for a
    general seven-joint arm.
    """

    lower: Tensor
    upper: Tensor
    speed_limit: Tensor
    _frequencies: Tensor
    _phases: Tensor
    _weights: Tensor

    def __init__(
        self,
        chain: pytorch_kinematics.SerialChain,
        *,
        speed_limit: float | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> None:
        """Take over ``chain``; ``speed_limit`` [rad/s] replaces the description's own.

        Raises:
            InputError: the chain has a joint that is neither fixed nor revolute, or none that moves.
        """
        super().__init__()
        joints = _joints(chain)
        self.joint_names: tuple[str, ...] = tuple(chain.get_joint_parameter_names())
        self.num_joints = len(self.joint_names)
        form = trigonometric_form(joints)
        lower, upper = chain.get_joint_limits()
        speeds = [speed_limit] * self.num_joints if speed_limit else chain.get_joint_velocity_limits()[1]
        constants = {
            "lower": lower, "upper": upper, "speed_limit": speeds,
            "_frequencies": form.frequencies, "_phases": form.phases, "_weights": form.weights,
        }  # fmt: skip
        for name, value in constants.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=dtype, device=device), persistent=False)

    @classmethod
    def ur5(
        cls,
        *,
        tool_length: float = 0.0,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> Arm:
        """The UR5 with its tool frame ``tool_length`` [m] in front of the flange, along the flange's z axis."""
        return cls.from_urdf(ur5_urdf(tool_length), tip="tool", speed_limit=UR5_SPEED_LIMIT, dtype=dtype, device=device)

    @classmethod
    def from_urdf(cls, text: str, *, tip: str, **options: Any) -> Arm:
        """Parse URDF ``text`` from its root to the link ``tip``; ``options`` go to the constructor."""
        import pytorch_kinematics as pk

        tree = pk.build_chain_from_urdf(text.encode())
        check_choice("link", tip, tree.get_link_names())
        return cls(pk.SerialChain(tree, tip), **options)

    def forward(self, joint_pos: Tensor) -> Tensor:
        """Pose of the tool, ``(*B, N)`` [rad] -> ``(*B, 4, 4)``, base frame [m]."""
        return self.pose_and_jacobian(joint_pos)[0]

    def pose_and_jacobian(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Pose ``(*B, 4, 4)`` [m] and geometric Jacobian ``(*B, 6, N)`` with rows [v; ω], both in the base frame.

        Raises:
            InputError: ``joint_pos`` is not ``(*B, N)``.
        """
        if not torch.compiler.is_compiling():
            check_trailing_shape("joint_pos", joint_pos, self.num_joints)
        batch = joint_pos.shape[:-1]
        flat = joint_pos.reshape(-1, self.num_joints)
        entries = torch.addmm(self._phases, flat, self._frequencies).sin() @ self._weights
        return entries[:, :16].view(*batch, 4, 4), entries[:, 16:].view(*batch, 6, self.num_joints)


def _joints(chain: pytorch_kinematics.SerialChain) -> list[Joint]:
    """The chain's frames as joints; pytorch-kinematics keeps the offset after a joint in its link."""
    joints: list[Joint] = []
    for frame in chain._serial_frames:
        if frame.joint.joint_type not in ("fixed", "revolute"):
            raise InputError(
                f"joint {frame.joint.name!r} is {frame.joint.joint_type}; Arm handles fixed and revolute joints"
            )
        before, after = _matrix(frame.joint.offset), _matrix(frame.link.offset)
        axis = frame.joint.axis.to(torch.float64) if frame.joint.joint_type == "revolute" else None
        joints += [Joint(offset=before, axis=axis), Joint(offset=after, axis=None)]
    if all(joint.axis is None for joint in joints):
        raise InputError("the chain has no joint that moves; Arm needs at least one")
    return joints


def _matrix(transform: pytorch_kinematics.Transform3d | None) -> Tensor:
    if transform is None:
        return torch.eye(4, dtype=torch.float64)
    return transform.get_matrix()[0].to(torch.float64)
