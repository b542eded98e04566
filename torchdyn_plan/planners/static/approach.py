"""How a tool comes to its goal: which way it goes from where it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError


class Approach(Protocol):
    """A rule by which a tool comes to its goal.

    Coordinates come one by one, so that a compiler can fuse the rule into the loop around it.
    """

    def twist(self, pose: Sequence[Tensor], goal: Sequence[Tensor], /) -> list[Tensor]:
        """The twist still to go, the first R of its six rows [v; ω] in m and rad, in the arm's base frame.

        Args:
            pose: the first three rows of the tool's pose in the base frame, entry by entry [m].
            goal: x, y and z [m, world].
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
