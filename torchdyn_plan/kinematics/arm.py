"""A serial arm as batched torch: its pose and Jacobian in a handful of tensor operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice, check_same_device, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.components import ComponentForm
from torchdyn_plan.kinematics.descriptions import joints_of_chain, joints_of_mjcf, joints_of_urdf
from torchdyn_plan.kinematics.forms import FORMS, SineForm, TransformForm
from torchdyn_plan.kinematics.joint import Joint, merge_fixed
from torchdyn_plan.kinematics.ur5 import UR5_SPEED_LIMIT, ur5_urdf
from torchdyn_plan.precision import Precise

if TYPE_CHECKING:
    import pytorch_kinematics


class Arm(Precise):
    """A serial chain of N revolute and prismatic joints, parsed by pytorch-kinematics and evaluated in closed form.

    It computes in float32 or float64; ``half()`` leaves it in float32.
    The buffers ``lower``, ``upper`` (N,) [rad; m] and ``speed_limit`` (N,) [rad/s; m/s] hold the joints' limits.

    ``form`` says how the arm is evaluated; all forms are exact, and the attribute of that name does the work:

    - ``"sines"``: pose and Jacobian as one product of sines, the fastest as long as there are few of them: 81 for a
      UR5, about a thousand for a general seven-joint arm. Prismatic joints must come before the revolute ones.
    - ``"transforms"``: the product of a few transforms, each of some neighbouring joints and itself made of sines.
    - ``"auto"`` (default): sines, unless there would be more than `forms.MOST_SINES` of them or there cannot be any.

    ``components`` is the same once more as code for a compiler, see `ComponentForm`.
    """

    lower: Tensor
    upper: Tensor
    speed_limit: Tensor

    def __init__(
        self,
        joints: Sequence[Joint],
        *,
        speed_limit: float | None = None,
        form: str = "auto",
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> None:
        """Build from ``joints``, base to tip; ``speed_limit`` [rad/s; m/s] replaces their own.

        Where offsets of joints require gradients, pose and Jacobian have gradients in them.

        Raises:
            InputError: no joint moves, the form is unknown, or a prismatic joint cannot be had in sines.
        """
        super().__init__()
        check_choice("form", form, FORMS)
        moving, tool = merge_fixed(joints)
        if not moving:
            raise InputError("the chain has no joint that moves; Arm needs at least one")
        self.joint_names: tuple[str, ...] = tuple(joint.name for joint in moving)
        self.joint_kinds: tuple[str, ...] = tuple(joint.kind for joint in moving)
        self.num_joints = len(moving)
        self._made_from = {"joints": (*moving, Joint(offset=tool)), "speed_limit": speed_limit, "form": form}
        limits = {
            "lower": [joint.lower for joint in moving],
            "upper": [joint.upper for joint in moving],
            "speed_limit": [joint.speed_limit if speed_limit is None else speed_limit for joint in moving],
        }
        for name, values in limits.items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64), persistent=False)
        self.form = FORMS[form](moving, tool)
        self.components = ComponentForm(moving, tool)
        self.to(device=device, dtype=dtype)

    def part_settings(self) -> dict[str, Any]:
        """Arguments of the constructor that make the same arm, on the CPU."""
        return {**self._made_from, "dtype": self.lower.dtype}

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
    def from_urdf(cls, text: str, *, tip: str, base: str | None = None, **options: Any) -> Arm:
        """The arm from the link ``base`` (default: the root) to the link ``tip`` of URDF ``text``.

        Args:
            text: the description.
            tip: link whose frame is the tool's.
            base: link whose frame is the base frame.
            options: of the constructor.

        Raises:
            InputError: the text cannot be read, a link is unknown, or a joint is of a kind that `Arm` cannot handle.
        """
        return cls(joints_of_urdf(text, base=base, tip=tip), **options)

    @classmethod
    def from_mjcf(cls, text: str, *, tip: str, base: str | None = None, **options: Any) -> Arm:
        """The arm from the body ``base`` (default: the world) to the body or site ``tip`` of MJCF ``text``.

        MuJoCo itself, which the extra ``sim`` brings, reads the text. Arguments and errors are those of `from_urdf`.
        """
        return cls(joints_of_mjcf(text, base=base, tip=tip), **options)

    @classmethod
    def from_chain(cls, chain: pytorch_kinematics.SerialChain, **options: Any) -> Arm:
        """The arm of a chain that pytorch-kinematics has parsed, as precise as the chain (float32 by default)."""
        return cls(joints_of_chain(chain), **options)

    def forward(self, joint_pos: Tensor) -> Tensor:
        """Pose of the tool, ``(*B, N)`` [rad; m] -> ``(*B, 4, 4)``, base frame [m]."""
        self.check(joint_pos)
        if joint_pos.ndim == 2:
            return self.form(joint_pos)
        return self.form(joint_pos.reshape(-1, self.num_joints)).view(*joint_pos.shape[:-1], 4, 4)

    def pose_and_jacobian(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Pose ``(*B, 4, 4)`` [m] and geometric Jacobian ``(*B, 6, N)`` with rows [v; ω], both in the base frame.

        Raises:
            InputError: ``joint_pos`` is not ``(*B, N)``, or of another device or precision than the arm.
        """
        self.check(joint_pos)
        if joint_pos.ndim == 2:
            # A module's attribute that is a module takes as long to look up as a small operation.
            form = cast(SineForm | TransformForm, self._modules["form"])
            return form.pose_and_jacobian(joint_pos)
        batch = joint_pos.shape[:-1]
        pose, jacobian = self.form.pose_and_jacobian(joint_pos.reshape(-1, self.num_joints))
        return pose.view(*batch, 4, 4), jacobian.view(*batch, 6, self.num_joints)

    def check(self, joint_pos: Tensor) -> None:
        """Raise `InputError` unless ``joint_pos`` is ``(*B, N)``, of the arm's device and precision."""
        lower = cast(Tensor, self._buffers["lower"])
        good = isinstance(joint_pos, Tensor) and joint_pos.dtype == lower.dtype and joint_pos.device == lower.device
        if good and joint_pos.shape[-1:] == lower.shape:
            return
        check_trailing_shape("joint_pos", joint_pos, self.num_joints)
        check_same_device("joint_pos", joint_pos, lower.device, "the arm")
        raise InputError(f"joint_pos is {joint_pos.dtype}, but the arm is {lower.dtype}: convert one of them")
