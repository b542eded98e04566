"""A serial arm as batched torch: its pose and Jacobian in a handful of tensor operations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice, check_finite, check_same_device, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.components import ComponentForm
from torchdyn_plan.kinematics.coupling import CoupledComponents, CoupledForm, drivers_of, full_turns
from torchdyn_plan.kinematics.descriptions import Source, joints_of_chain
from torchdyn_plan.kinematics.forms import FORMS
from torchdyn_plan.kinematics.joint import Joint, check_limits, merge_fixed
from torchdyn_plan.kinematics.mjcf import joints_of_mjcf
from torchdyn_plan.kinematics.ur5 import UR5_SPEED_LIMIT, ur5_urdf
from torchdyn_plan.kinematics.urdf import joints_of_urdf
from torchdyn_plan.precision import Precise

if TYPE_CHECKING:
    import pytorch_kinematics

    from torchdyn_plan.kinematics.mjcf import MjcfSource


class Arm(Precise):
    """A serial chain of N revolute and prismatic joints, read from a description and evaluated in closed form.

    It computes in float32 or float64; ``half()`` leaves it in float32. The buffers ``lower``, ``upper`` (N,) [rad; m]
    and ``speed_limit`` (N,) [rad/s; m/s] hold the joints' limits. A speed limit missing in the description is infinite,
    and `needed_speed_limit` raises if it is.

    If one joint of the chain moves with another, at ratio · q + shift (`Coupling`), the arm has one position for both,
    named after the driving joint, with limits that hold for both.

    ``joint_names``, ``joint_kinds`` and ``full_turns`` (whether a full turn leaves the pose unchanged) describe the N
    positions.

    ``form`` selects how the arm is evaluated; all forms are exact, and the attribute of that name holds the one in use:

    - ``"sines"``: pose and Jacobian as one product of sines, the fastest if there are few of them: 81 for a UR5, about
      a thousand for a general seven-joint arm, and at most `trigonometric.MOST_TERMS` terms. Prismatic joints must come
      before the revolute ones.
    - ``"transforms"``: a product of a few transforms, each over some neighbouring joints and made of sines itself.
    - ``"auto"`` (default): sines, unless there are more than `forms.MOST_SINES` of them or the chain has no such form.

    ``components`` is the same in a form for compilers, see `ComponentForm`.
    """

    lower: Tensor
    upper: Tensor
    speed_limit: Tensor

    def __init__(
        self,
        joints: Sequence[Joint],
        *,
        tool: Tensor | Sequence[Sequence[float]] | None = None,
        speed_limit: float | Sequence[float] | None = None,
        form: str = "auto",
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> None:
        """Build from ``joints``, base to tip.

        If joint offsets or the tool require gradients, pose and Jacobian have gradients with respect to them.

        Args:
            joints: base to tip.
            tool: ``(4, 4)``, pose of the tool in the frame after the last joint [m]; identity by default.
            speed_limit: replaces the joints' limits, one for all or one for each [rad/s; m/s].
            form: see above.
            dtype: torch.float32 or torch.float64.
            device: CPU by default.

        Raises:
            InputError: no joint moves, a joint's numbers are invalid, the form is unknown, a prismatic joint has no
                form in sines, or there would be too many sines.
        """
        super().__init__()
        check_choice("form", form, FORMS)
        moving, end = merge_fixed(joints if tool is None else [*joints, Joint(offset=_tool(tool), name="tool")])
        if not moving:
            raise InputError("the chain has no joint that moves; Arm needs at least one")
        drivers, ratios, shifts = drivers_of(moving)
        self.joint_names: tuple[str, ...] = tuple(joint.name for joint in drivers)
        self.joint_kinds: tuple[str, ...] = tuple(joint.kind for joint in drivers)
        self.full_turns = full_turns(moving, ratios)
        self.num_joints = len(drivers)
        self._made_from = {"joints": (*moving, Joint(offset=end)), "speed_limit": speed_limit, "form": form}
        limits = {
            "lower": [joint.lower for joint in drivers],
            "upper": [joint.upper for joint in drivers],
            "speed_limit": _speed_limits(drivers, speed_limit),
        }
        for name, values in limits.items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64), persistent=False)
        self.form, self.components = FORMS[form](moving, end), ComponentForm(moving, end)
        if any(joint.coupling is not None for joint in moving):
            self.form = CoupledForm(self.form, ratios, shifts)
            self.components = CoupledComponents(self.components, ratios, shifts)
        self.to(device=device, dtype=dtype)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this arm, on the CPU."""
        return {**self._made_from, "dtype": self.lower.dtype}

    @classmethod
    def ur5(
        cls,
        *,
        tool_length: float = 0.0,
        speed_limit: float = UR5_SPEED_LIMIT,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> Arm:
        """The UR5 with its tool frame ``tool_length`` [m] in front of the flange, along the flange's z axis.

        ``speed_limit`` holds for every joint [rad/s].
        """
        return cls.from_urdf(ur5_urdf(tool_length), tip="tool", speed_limit=speed_limit, dtype=dtype, device=device)

    @classmethod
    def from_urdf(cls, source: Source, *, tip: str, base: str | None = None, **options: Any) -> Arm:
        """The arm from the link ``base`` (default: the root) to the link ``tip`` of URDF.

        Only the joints between the two are read, and joints that these mimic.

        Args:
            source: the text, or the path of its file.
            tip: link whose frame is the tool's.
            base: link whose frame is the base frame.
            options: of the constructor; ``tool`` is a pose in the frame of the tip.

        Raises:
            InputError: the text cannot be read, a link is unknown, or a joint is of a kind that `Arm` cannot handle.
        """
        return cls(joints_of_urdf(source, base=base, tip=tip), **options)

    @classmethod
    def from_mjcf(cls, source: MjcfSource, *, tip: str, base: str | None = None, **options: Any) -> Arm:
        """The arm from the body ``base`` (default: the world) to the body or site ``tip`` of MJCF.

        MuJoCo (extra ``sim``) reads the scene, which may contain anything else. If a site and a body share a name,
        ``tip`` is the site; use ``body:name`` or ``site:name`` to choose. Elements without a name are called by their
        index in the compiled model, such as ``joint#3``. Joints coupled by an equality of two joints, or of fixed
        tendons over two joints, count as one; tendon limits, and weld and connect constraints, are ignored. MJCF has no
        speed limits.

        Args:
            source: the text, the path of its file (whose folder is searched for meshes and includes), an `MjSpec` or an
                `MjModel`.
            tip: body or site whose frame is the tool's.
            base: body whose frame is the base frame.
            options: of the constructor; ``tool`` is a pose in the frame of the tip.

        Raises:
            InputError: see `from_urdf`.
        """
        return cls(joints_of_mjcf(source, base=base, tip=tip), **options)

    @classmethod
    def from_chain(cls, chain: pytorch_kinematics.SerialChain, **options: Any) -> Arm:
        """The arm of a chain parsed by pytorch-kinematics, at the chain's precision (float32 by default)."""
        return cls(joints_of_chain(chain), **options)

    def needed_speed_limit(self, owner: str) -> Tensor:
        """``speed_limit``, for an ``owner`` that requires it.

        Raises:
            InputError: a joint has none.
        """
        limits = enumerate(zip(self.joint_names, self.speed_limit.tolist(), strict=True))
        unlimited = [repr(name) if name else f"number {index}" for index, (name, speed) in limits if speed == math.inf]
        if unlimited:
            names = ", ".join(unlimited)
            raise InputError(
                f"{owner} needs the speed limits of all joints, and the description gives none for {names}: give the "
                "arm a speed_limit=, one number for all joints or one for each [rad/s; m/s]"
            )
        return self.speed_limit

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
        # Looking up a submodule as an attribute costs as much as a small operation.
        form: Any = self._modules["form"]
        self.check(joint_pos)
        if joint_pos.ndim == 2:
            return form.pose_and_jacobian(joint_pos)
        batch = joint_pos.shape[:-1]
        pose, jacobian = form.pose_and_jacobian(joint_pos.reshape(-1, self.num_joints))
        return pose.view(*batch, 4, 4), jacobian.view(*batch, 6, self.num_joints)

    def check(self, joint_pos: Tensor) -> None:
        """Raise `InputError` unless ``joint_pos`` is ``(*B, N)``, of the arm's device and precision."""
        lower: Any = self._buffers["lower"]
        good = isinstance(joint_pos, Tensor) and joint_pos.dtype == lower.dtype and joint_pos.device == lower.device
        if good and joint_pos.ndim > 0 and joint_pos.shape[-1] == self.num_joints:
            return
        check_trailing_shape("joint_pos", joint_pos, self.num_joints)
        check_same_device("joint_pos", joint_pos, lower.device, "the arm")
        raise InputError(f"joint_pos is {joint_pos.dtype}, but the arm is {lower.dtype}: convert one of them")


def _tool(pose: Tensor | Sequence[Sequence[float]]) -> Tensor:
    """A tool's pose ``(4, 4)`` as float64, checked."""
    try:
        tool = torch.as_tensor(pose)
        tool = tool.to("cpu", torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"tool must be a pose (4, 4) of numbers, got {pose!r}") from error
    if tool.shape != (4, 4):
        raise InputError(f"tool must have shape (4, 4), got {tuple(tool.shape)}")
    check_finite("tool", tool)
    fixed = tool.detach()
    off = fixed[:3, :3] @ fixed[:3, :3].T - torch.eye(3, dtype=torch.float64)
    if off.abs().max() > 1e-5 or torch.linalg.det(fixed[:3, :3]) < 0.0 or fixed[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(f"tool must be a rotation and a position, over a row of 0, 0, 0, 1, got {fixed.tolist()}")
    return tool


def _speed_limits(joints: Sequence[Joint], given: float | Sequence[float] | None) -> list[float]:
    """The speed limit of each joint: its own, or the one that is given."""
    if given is None:
        return [joint.speed_limit for joint in joints]
    values = [given] * len(joints) if isinstance(given, (int, float)) else list(given)
    if len(values) != len(joints):
        raise InputError(f"speed_limit must be one number, or {len(joints)}, one for each joint, got {len(values)}")
    limited = [replace(joint, speed_limit=float(value)) for joint, value in zip(joints, values, strict=True)]
    for joint in limited:
        check_limits(joint)
    return [joint.speed_limit for joint in limited]
