"""Orientation of the tool where it meets its target: a part of planners whose goals are poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number, check_trailing_shape, check_vector
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.quaternions import quat_between, quat_matrix, quat_multiply


class Turn(Protocol):
    """Gives the tool's orientation at each position of a forecast."""

    @property
    def in_keys(self) -> Sequence[Any]:
        """Keys that it reads from the observation in addition to the target's position."""
        ...

    def __call__(self, path: Tensor, target_pos: Tensor, /, *seen: Tensor) -> Tensor:
        """Quaternions wxyz ``(*B, F, 4)`` of the tool in the world; zeros where any orientation will do.

        Args:
            path: ``(*B, F, 3)`` forecast of the target for 1 … F control steps [m, world].
            target_pos: ``(*B, 3)`` its current position [m, world].
            seen: the values of ``in_keys``, ``(*B, …)`` each.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class WithTarget:
    """Aligns the tool with the target, whose orientation (``target_quat``) is assumed constant.

    By default the tool points down on a target that lies flat: z axes opposed, x axes aligned.
    """

    in_keys: ClassVar[tuple[str, ...]] = (keys.TARGET_QUAT,)

    quat: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)
    """Orientation of the tool in the target's frame, quaternion wxyz."""
    symmetry: int = 1
    """Order of the tool's rotational symmetry about its z axis."""
    facing: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Of the equivalent orientations, the one whose x axis is nearest to this world direction is taken, so that no
    joint winds up from target to target."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "quat", tuple(self.quat))
        if len(self.quat) != 4 or not any(self.quat):
            raise InputError(f"quat must be a quaternion wxyz other than zero, got {self.quat!r}")
        for value in self.quat:
            check_number("quat", value)
        check_number("symmetry", self.symmetry, minimum=1, integer=True)
        object.__setattr__(self, "facing", check_vector("facing", self.facing))

    def __call__(self, path: Tensor, target_pos: Tensor, *seen: Tensor) -> Tensor:
        """As of `Turn`."""
        (target_quat,) = seen
        check_trailing_shape(keys.TARGET_QUAT, target_quat, 4)
        quat = quat_multiply(target_quat, target_quat.new_tensor(self.quat).expand_as(target_quat))
        if self.symmetry > 1:
            quat = self._nearest(quat)
        return quat.unsqueeze(-2).expand(*path.shape[:-1], 4)

    def _nearest(self, quat: Tensor) -> Tensor:
        """The orientation equivalent to ``quat`` (*B, 4) under the tool's symmetry that is nearest to ``facing``."""
        half = math.pi / self.symmetry * torch.arange(self.symmetry, dtype=quat.dtype, device=quat.device)
        zero = torch.zeros_like(half)
        alike = torch.stack([half.cos(), zero, zero, half.sin()], dim=-1)
        quats = quat_multiply(quat.unsqueeze(-2), alike)
        faces = (quat_matrix(quats)[..., 0] * quats.new_tensor(self.facing)).sum(-1)
        best = faces.argmax(-1)[..., None, None]
        return quats.gather(-2, best.expand(*best.shape[:-1], 4)).squeeze(-2)


@dataclass(frozen=True, kw_only=True)
class AgainstVelocity:
    """The tool's z axis points against the target's velocity, as a cup into which a ball flies: ``target_history``.

    How the tool is turned about that axis does not matter: use it with `TurnedToGoal` of ``symmetry`` 0, which leaves
    it to the joints. A target that is expected to rest is taken to come as it moves now.
    """

    slowest: float = 1e-4
    """A target that moves less in a control step says nothing: the tool stays turned as it is [m]."""

    def __post_init__(self) -> None:
        check_number("slowest", self.slowest, minimum=0.0)

    @property
    def in_keys(self) -> Sequence[Any]:
        """As of `Turn`."""
        return (keys.TARGET_HISTORY,)

    def __call__(self, path: Tensor, target_pos: Tensor, *seen: Tensor) -> Tensor:
        """As of `Turn`."""
        (history,) = seen
        check_trailing_shape(keys.TARGET_HISTORY, history, history.shape[-2] if history.ndim > 1 else 2, 3)
        moves = torch.diff(path, dim=-2, prepend=target_pos.unsqueeze(-2))
        now = (target_pos - history[..., -2, :]).unsqueeze(-2)
        moves = torch.where(self._are_moves(moves), moves, now)
        known = self._are_moves(moves)
        # Of nothing, normalised, there would be no derivative.
        ahead = torch.where(known, -moves, moves.new_tensor([0.0, 0.0, 1.0]))
        return torch.where(known, quat_between(moves.new_tensor([0.0, 0.0, 1.0]), ahead), 0.0)

    def _are_moves(self, moves: Tensor) -> Tensor:
        """Whether steps ``(*B, F, 3)`` [m] lead anywhere, ``(*B, F, 1)`` bool."""
        return moves.square().sum(-1, keepdim=True) > self.slowest**2
