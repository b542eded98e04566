"""Explains why a planner could not use a tensordict, in one sentence that names the entry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import POINT_SIZES
from torchdyn_plan.errors import InputError, TorchdynPlanError

COUNTS = (keys.STEP_COUNT, keys.HISTORY_LENGTH, keys.EPISODE, keys.TARGETS_PRESENT)
"""Keys of integers or booleans."""


def explain(error: Exception, planner: Any, tensordict: Any) -> InputError | None:
    """What is wrong with the ``tensordict`` on which a ``planner`` failed with ``error``; None if nothing is."""
    fault = find_fault(tensordict, planner.in_keys, type(planner).__name__) or find_memory_fault(tensordict, planner)
    # An error of our own that names the entry is more specific.
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
    coordinates = _coordinates(tensordict)
    for key in read:
        value = tensordict.get(key, None) if isinstance(key, str) else None
        if value is None:
            continue
        if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_meta:
            return Fault(key, f"{key} must be a tensor that holds numbers, got {_kind(value)}")
        if key in sizes and not value.is_floating_point() and (key not in COUNTS or value.is_complex()):
            return Fault(key, f"{key} must hold floating-point numbers, got {value.dtype}")
        expected, shape = sizes.get(key), tuple(value.shape)
        if expected is not None:
            expected = tuple(coordinates if size == "D" else size for size in expected)
        if expected is not None and not _fits(shape, batch, expected):
            wanted = ", ".join(map(str, (*batch, *expected)))
            return Fault(key, f"{key} must have shape ({wanted}) in a tensordict of batch size {batch}, got {shape}")
    return None


def find_memory_fault(tensordict: TensorDictBase, planner: Any) -> Fault | None:
    """Why ``planner`` cannot continue from the memory under ``plan`` in ``tensordict``; None if it can."""
    plan, batch = tensordict.get(keys.PLAN, None), tuple(tensordict.batch_size)
    remedy = "leave what the planner wrote there unchanged, or remove all of it"
    if plan is None:
        return None
    if not isinstance(plan, TensorDictBase):
        return Fault(keys.PLAN, f"{keys.PLAN} must be a tensordict, a planner's memory, got {_kind(plan)}: {remedy}")
    for name, like in planner.empty_memory(torch.zeros(_coordinates(tensordict))).items():
        value, place = plan.get(name, None), f"({keys.PLAN!r}, {name!r})"
        if value is None:
            continue
        shape, kind = (*batch, *like.shape), _number_kind(like)
        if not isinstance(value, Tensor) or value.layout != torch.strided or _number_kind(value) != kind:
            return Fault(name, f"{place} must hold {kind}, got {_kind(value)}: {remedy}")
        if tuple(value.shape) != shape:
            return Fault(name, f"{place} must have shape {shape}, got {tuple(value.shape)}: {remedy}")
    return None


def _coordinates(tensordict: TensorDictBase) -> int:
    """Coordinates of positions in ``tensordict``, from the tool or the target; 3 if it has neither."""
    for key in (keys.TOOL_POS, keys.TARGET_POS):
        value = tensordict.get(key, None)
        if isinstance(value, Tensor) and value.ndim and value.shape[-1] in POINT_SIZES:
            return value.shape[-1]
    return POINT_SIZES[-1]


def _kind(value: Any) -> str:
    """A short description of ``value``."""
    if not isinstance(value, Tensor):
        return type(value).__name__
    where = "on no device, " if value.is_meta else ""
    return f"{where}{value.dtype}" if value.layout == torch.strided else f"{value.layout}, {value.dtype}"


def _number_kind(value: Tensor) -> str:
    if value.dtype == torch.bool:
        return "true or false"
    if value.is_complex():
        return "complex numbers"
    return "floating-point numbers" if value.is_floating_point() else "whole numbers"


def _fits(shape: tuple[int, ...], batch: tuple[int, ...], expected: tuple[str | int, ...]) -> bool:
    """Whether ``shape`` is ``batch`` followed by ``expected``, where letters stand for any size."""
    trailing = shape[len(batch) :]
    if shape[: len(batch)] != batch:
        return False
    # Step counts may lack their last axis.
    if expected == (1,) and trailing == ():
        return True
    return len(trailing) == len(expected) and all(
        isinstance(size, str) or size == got for size, got in zip(expected, trailing, strict=True)
    )
