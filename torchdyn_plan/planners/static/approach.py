"""How a tool comes to its goal: which way it goes from where it is."""

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
    """A rule by which a tool comes to its goal.

    Coordinates come one by one, so that a compiler can fuse the rule into the loop around it.
    """

    def twist(self, pose: Sequence[Tensor], goal: Sequence[Tensor], /) -> list[Tensor]:
        """The twist still to go, the first R of its six rows [v; ω] in m and rad, in the arm's base frame.

        Args:
            pose: the first three rows of the tool's pose in the base frame, entry by entry [m].
            goal: x, y and z [m, world]; of an approach with ``reads_pose`` the quaternion wxyz after them.
        """
        ...

    def within_reach(self, goal: Tensor, /) -> Tensor:
        """``goal`` (*B, 3) [m, world], or the nearest place to it where the tool can be."""
        ...


@dataclass(frozen=True, kw_only=True)
class StraightToGoal:
    """The tool goes straight to its goal, however it is turned: the approach of an arm that is given none."""

    base_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the arm's base frame in the world, axes parallel [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "base_pos", tuple(self.base_pos))
        if len(self.base_pos) != 3:
            raise InputError(f"base_pos must be x, y and z [m], got {self.base_pos!r}")
        for coordinate in self.base_pos:
            check_number("base_pos", coordinate)

    def twist(self, pose: Sequence[Tensor], goal: Sequence[Tensor]) -> list[Tensor]:
        """The way from the tool to the goal."""
        place = pose[3], pose[7], pose[11]
        return [end - start - base for end, start, base in zip(goal, place, self.base_pos, strict=True)]

    def within_reach(self, goal: Tensor) -> Tensor:
        """The goal itself: how far the arm reaches is not known here."""
        return torch.as_tensor(goal)


@dataclass(frozen=True, kw_only=True)
class TurnedToGoal:
    """The tool goes straight to its goal, and turns as ``goal_pose`` says on the way there.

    A quaternion of zeros leaves the tool turned as it is.
    """

    reads_pose: ClassVar[bool] = True

    base_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the arm's base frame in the world, axes parallel [m]."""
    symmetry: int = 1
    """The tool is the same after one ``symmetry``-th of a turn about its z axis: 2 for a two-finger gripper, 4 for a
    square box, 0 for a round cup, of which only the z axis counts."""

    def __post_init__(self) -> None:
        StraightToGoal(base_pos=self.base_pos)
        object.__setattr__(self, "base_pos", tuple(self.base_pos))
        check_number("symmetry", self.symmetry, minimum=0, integer=True)

    def twist(self, pose: Sequence[Tensor], goal: Sequence[Tensor]) -> list[Tensor]:
        """The way from the tool to the goal, and the turn that is left, a rotation vector in the base frame."""
        place, quat = goal[:3], torch.stack(list(goal[3:]), dim=-1)
        way = StraightToGoal(base_pos=self.base_pos).twist(pose, place)
        turned = torch.stack([torch.stack(list(pose[row : row + 3]), dim=-1) for row in (0, 4, 8)], dim=-2)
        turn = torch.where(is_turned(quat).unsqueeze(-1), self._turn(turned, quat_matrix(quat)), 0.0)
        return [*way, *turn.unbind(-1)]

    def _turn(self, turned: Tensor, wanted: Tensor) -> Tensor:
        """Rotation vector ``(*B, 3)`` [rad] from one rotation to another, ``(*B, 3, 3)`` each, or to its like."""
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
    """Whether an approach is told how the tool is to be turned: its goals are ``goal_pose``."""
    return bool(getattr(approach, "reads_pose", False))
