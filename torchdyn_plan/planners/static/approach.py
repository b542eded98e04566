"""How the tool approaches its goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.quaternions import is_turned, quat_between, quat_matrix
from torchdyn_plan.kinematics.targets import nearest_turn, rotation_vector


class Approach(Protocol):
    """A rule by which the tool approaches its goal.

    Coordinates are passed one by one, so that a compiler can fuse the rule into the surrounding loop.
    """

    def twist(self, pose: Sequence[Tensor], goal: Sequence[Tensor], /) -> list[Tensor]:
        """The remaining twist: the first R of its six rows [v; ω] in m and rad, in the arm's base frame.

        Args:
            pose: the first three rows of the tool's pose in the base frame, entry by entry [m].
            goal: x, y and z [m, world], followed by the quaternion wxyz for an approach with ``reads_pose``.
        """
        ...

    def within_reach(self, goal: Tensor, /) -> Tensor:
        """``goal`` (*B, 3) [m, world], or the nearest position that the tool can reach."""
        ...


@dataclass(frozen=True, kw_only=True)
class StraightToGoal:
    """The tool goes straight to its goal, in any orientation. The default approach."""

    base_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the arm's base frame in the world, axes parallel [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "base_pos", tuple(self.base_pos))
        if len(self.base_pos) != 3:
            raise InputError(f"base_pos must be x, y and z [m], got {self.base_pos!r}")
        for coordinate in self.base_pos:
            check_number("base_pos", coordinate)

    def twist(self, pose: Sequence[Tensor], goal: Sequence[Tensor]) -> list[Tensor]:
        """The vector from the tool to the goal."""
        place = pose[3], pose[7], pose[11]
        return [end - start - base for end, start, base in zip(goal, place, self.base_pos, strict=True)]

    def within_reach(self, goal: Tensor) -> Tensor:
        """The goal itself: how far the arm reaches is not known here."""
        return torch.as_tensor(goal)


@dataclass(frozen=True, kw_only=True)
class TurnedToGoal:
    """The tool goes straight to its goal, and turns to the orientation in ``goal_pose`` on the way.

    A zero quaternion keeps the tool's orientation.
    """

    reads_pose: ClassVar[bool] = True

    base_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the arm's base frame in the world, axes parallel [m]."""
    symmetry: int = 1
    """Order of the tool's rotational symmetry about its z axis: 2 for a two-finger gripper, 4 for a square box, 0 for a
    round cup, where only the direction of the z axis counts."""

    def __post_init__(self) -> None:
        StraightToGoal(base_pos=self.base_pos)
        object.__setattr__(self, "base_pos", tuple(self.base_pos))
        check_number("symmetry", self.symmetry, minimum=0, integer=True)

    def twist(self, pose: Sequence[Tensor], goal: Sequence[Tensor]) -> list[Tensor]:
        """The vector from the tool to the goal, and the remaining rotation vector, in the base frame."""
        place, quat = goal[:3], torch.stack(list(goal[3:]), dim=-1)
        way = StraightToGoal(base_pos=self.base_pos).twist(pose, place)
        turned = torch.stack([torch.stack(list(pose[row : row + 3]), dim=-1) for row in (0, 4, 8)], dim=-2)
        turn = torch.where(is_turned(quat).unsqueeze(-1), self._turn(turned, quat_matrix(quat)), 0.0)
        return [*way, *turn.unbind(-1)]

    def _turn(self, turned: Tensor, wanted: Tensor) -> Tensor:
        """Rotation vector ``(*B, 3)`` [rad] between rotations ``(*B, 3, 3)``, the smallest under the symmetry."""
        if self.symmetry == 0:
            start, end = turned[..., 2], wanted[..., 2]
            return rotation_vector(quat_matrix(quat_between(start, end)))
        if self.symmetry > 1:
            wanted = wanted @ nearest_turn(wanted.mT @ turned, self.symmetry)
        return rotation_vector(wanted @ turned.mT)

    def within_reach(self, goal: Tensor) -> Tensor:
        """The goal itself: how far the arm reaches is not known here."""
        return torch.as_tensor(goal)


def reads_pose(approach: Approach) -> bool:
    """Whether an approach reads the tool's orientation: its goals are ``goal_pose``."""
    return bool(getattr(approach, "reads_pose", False))


def is_round(approach: Approach) -> bool:
    """Whether the tool of an approach is the same after any turn about its z axis."""
    return getattr(approach, "symmetry", 1) == 0
