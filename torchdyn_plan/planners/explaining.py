"""What is wrong with a tensordict that a planner could not work with: one sentence that names the entry."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError, TorchdynPlanError

COUNTS = (keys.STEP_COUNT, keys.HISTORY_LENGTH, keys.EPISODE)
"""Keys that hold whole numbers."""


def explained(forward: Callable[..., Any]) -> Callable[..., Any]:
    """``forward`` of a planner, whose errors of other libraries become an `InputError` where the input explains them.

    Nothing is looked at before something fails: a step that works costs nothing more.
    """

    @functools.wraps(forward)
    def explaining(self: Any, tensordict: Any, *more: Any, **settings: Any) -> Any:
        if torch.compiler.is_compiling():
            return forward(self, tensordict, *more, **settings)
        try:
            return forward(self, tensordict, *more, **settings)
        except Exception as error:
            fault = find_fault(tensordict, self.in_keys, type(self).__name__)
            # An error of our own that names the entry says more of it.
            named = isinstance(error, TorchdynPlanError) and fault is not None and fault.name in str(error)
            if fault is None or named:
                raise
            raise InputError(fault.sentence) from error

    return explaining


class Fault(NamedTuple):
    """What is wrong with a tensordict."""

    name: str
    """The key, or ``tensordict`` for all of it."""
    sentence: str


def find_fault(tensordict: Any, read: Sequence[Any], reader: str) -> Fault | None:
    """Why ``reader`` cannot read the keys ``read`` in ``tensordict`` or write to it; None if it can."""
    if not isinstance(tensordict, TensorDictBase):
        return Fault("tensordict", f"{reader} reads and writes a tensordict, got {type(tensordict).__name__}")
    if tensordict.is_locked:
        sentence = f"{reader} writes to its tensordict, and this one is locked: give it a copy, tensordict.copy()"
        return Fault("tensordict", sentence)
    batch, sizes = tuple(tensordict.batch_size), {key.name: key.shape for key in keys.KEYS}
    for key in read:
        value = tensordict.get(key, None)
        if not isinstance(value, Tensor):
            continue
        if key in sizes and not value.is_floating_point() and (key not in COUNTS or value.is_complex()):
            return Fault(key, f"{key} must hold floating-point numbers, got {value.dtype}")
        expected, shape = sizes.get(key), tuple(value.shape)
        if expected is not None and not _fits(shape, batch, expected):
            wanted = ", ".join(map(str, (*batch, *expected)))
            return Fault(key, f"{key} must have shape ({wanted}) in a tensordict of batch size {batch}, got {shape}")
    return None


def _fits(shape: tuple[int, ...], batch: tuple[int, ...], expected: tuple[str | int, ...]) -> bool:
    """Whether ``shape`` is ``batch`` and then ``expected``, of which letters stand for any size."""
    trailing = shape[len(batch) :]
    if shape[: len(batch)] != batch:
        return False
    # Step counts may lack their last axis.
    if expected == (1,) and trailing == ():
        return True
    return len(trailing) == len(expected) and all(
        isinstance(size, str) or size == got for size, got in zip(expected, trailing, strict=True)
    )
