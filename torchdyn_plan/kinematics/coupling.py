"""Arms with coupled joints: maps the N independent positions to those of the chain's M joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.components import ComponentForm, Matrix, Vector, add, multiply
from torchdyn_plan.kinematics.forms import SineForm, TransformForm
from torchdyn_plan.kinematics.joint import Coupling, Joint
from torchdyn_plan.precision import Precise, autocast_is_on, without_autocast


def drivers_of(joints: Sequence[Joint]) -> tuple[list[Joint], Tensor, Tensor]:
    """The N independent joints that determine the positions of the chain's M joints, q · ratios + shifts.

    Returns:
        The independent joints, in the order in which they first move the chain, with limits that hold for all joints
        they drive; ratios ``(N, M)`` and shifts ``(M,)``, float64.

    Raises:
        InputError: limits leave a joint no position.
    """
    followers: dict[str | int, list[int]] = {}
    couplings = [joint.coupling or Coupling(driver=joint) for joint in joints]
    coupled = {coupling.driver.name for coupling, joint in zip(couplings, joints, strict=True) if joint.coupling}
    for index, coupling in enumerate(couplings):
        # Joints that are not coupled may share a name, or have none.
        key = coupling.driver.name if coupling.driver.name in coupled else index
        followers.setdefault(key, []).append(index)
    ratios = torch.zeros(len(followers), len(joints), dtype=torch.float64)
    drivers = []
    for number, moved in enumerate(followers.values()):
        ratios[number, moved] = torch.tensor([couplings[index].ratio for index in moved], dtype=torch.float64)
        drivers.append(_limited(couplings[moved[0]].driver, [joints[index] for index in moved]))
    return drivers, ratios, torch.tensor([coupling.shift for coupling in couplings], dtype=torch.float64)


def _limited(driver: Joint, moved: Sequence[Joint]) -> Joint:
    """``driver`` with limits that keep all joints it drives within their own."""
    for joint in moved:
        if joint.coupling is None:
            continue
        ratio, shift = joint.coupling.ratio, joint.coupling.shift
        low, high = sorted(((joint.lower - shift) / ratio, (joint.upper - shift) / ratio))
        driver = replace(
            driver,
            lower=max(driver.lower, low),
            upper=min(driver.upper, high),
            speed_limit=min(driver.speed_limit, joint.speed_limit / abs(ratio)),
        )
        if driver.lower > driver.upper:
            raise InputError(f"joint {driver.name!r} moves joint {joint.name!r}, and their limits leave no position")
    return driver


class CoupledForm(Precise):
    """A form of the chain's M joints as a function of the N independent positions."""

    form: SineForm | TransformForm
    _ratios: Tensor
    _shifts: Tensor

    def __init__(self, form: SineForm | TransformForm, ratios: Tensor, shifts: Tensor) -> None:
        """Take a form, and the ratios ``(N, M)`` and shifts ``(M,)`` of `drivers_of`."""
        super().__init__()
        self.form = form
        self.register_buffer("_ratios", ratios, persistent=False)
        self.register_buffer("_shifts", shifts, persistent=False)

    def forward(self, joint_pos: Tensor) -> Tensor:
        """Pose ``(B, 4, 4)`` alone, for ``(B, N)``."""
        if autocast_is_on():
            return without_autocast(self.forward, joint_pos)
        return self.form(torch.addmm(self._shifts, joint_pos, self._ratios))

    def pose_and_jacobian(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Pose ``(B, 4, 4)`` and Jacobian ``(B, 6, N)``, for ``(B, N)``."""
        if autocast_is_on():
            return without_autocast(self.pose_and_jacobian, joint_pos)
        pose, jacobian = self.form.pose_and_jacobian(torch.addmm(self._shifts, joint_pos, self._ratios))
        return pose, jacobian @ self._ratios.mT


class CoupledComponents:
    """A `ComponentForm` of the chain's M joints as a function of the N independent positions."""

    def __init__(self, form: ComponentForm, ratios: Tensor, shifts: Tensor) -> None:
        """Take a form, and the ratios ``(N, M)`` and shifts ``(M,)`` of `drivers_of`."""
        self.form = form
        self.drivers: list[int] = ratios.abs().argmax(dim=0).tolist()
        self.ratios: list[float] = ratios.sum(dim=0).tolist()
        self.shifts: list[float] = shifts.tolist()

    def __call__(self, joint_pos: Sequence[Tensor]) -> tuple[Matrix, Vector, Matrix]:
        """Like `ComponentForm`, with N columns."""
        lines = list(zip(self.drivers, self.ratios, self.shifts, strict=True))
        positions = [add(multiply(ratio, joint_pos[driver]), shift) for driver, ratio, shift in lines]
        rotation, place, moved = self.form(cast(list[Tensor], positions))
        columns: Matrix = [[0.0] * 6 for _ in joint_pos]
        for column, (driver, ratio, _) in zip(moved, lines, strict=True):
            sums = zip(columns[driver], column, strict=True)
            columns[driver] = [add(total, multiply(ratio, entry)) for total, entry in sums]
        return rotation, place, columns


def full_turns(joints: Sequence[Joint], ratios: Tensor) -> tuple[bool, ...]:
    """Whether a full turn of each position leaves the chain's pose unchanged: all that it drives makes whole turns."""
    return tuple(
        all(
            joint.kind == "revolute" and math.isfinite(ratio) and ratio == round(ratio)
            for joint, ratio in zip(joints, row, strict=True)
            if ratio != 0.0
        )
        for row in ratios.tolist()
    )
