"""What a dynamic planner observes of robots and targets at one step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from torchdyn_plan import keys

SEEN_BY_ALL = (keys.TOOL_POS, keys.TARGET_POS, keys.ROBOT_STATE, keys.STEP_COUNT)
"""Keys of an observation, without those that the forecaster reads."""


class Observation(NamedTuple):
    """One step of a batch of robots."""

    tool_pos: Tensor
    """``(*B, D)`` [m, world]."""
    target_pos: Tensor
    """``(*B, D)`` [m, world]."""
    robot_state: Tensor
    """``(*B, S)``, read by the arrival model."""
    step_count: Tensor
    """``(*B,)`` int64 control steps since the reset."""
    seen: tuple[Tensor, ...]
    """Values read by the forecaster, ``(*B, …)`` each."""

    def flat(self) -> tuple[Tensor, ...]:
        """All tensors in one flat tuple."""
        return (*self[:4], *self.seen)

    @classmethod
    def of(cls, tensors: Sequence[Tensor]) -> Observation:
        """The inverse of `flat`."""
        return cls(tensors[0], tensors[1], tensors[2], tensors[3], tuple(tensors[4:]))
