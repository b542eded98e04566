"""What is wrong with a tensordict that a planner could not work with: one sentence that names the entry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError, TorchdynPlanError

COUNTS = (keys.STEP_COUNT, keys.HISTORY_LENGTH, keys.EPISODE)
"""Keys that hold whole numbers."""


def explain(error: Exception, planner: Any, tensordict: Any) -> InputError | None:
    """What is wrong with the ``tensordict`` on which a ``planner`` failed with ``error``; None if it is not that."""
    fault = find_fault(tensordict, planner.in_keys, type(planner).__name__)
    # An error of our own that names the entry says more of it.
    named = isinstance(error, TorchdynPlanError) and fault is not None and fault.name in str(error)
    return None if fault is None or named else InputError(fault.sentence)


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
