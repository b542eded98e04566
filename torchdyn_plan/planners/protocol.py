"""Interfaces of planners and their parts: anything that implements them can be used."""

from __future__ import annotations

from typing import Any, Protocol

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError


class StaticPlanner(Protocol):
    """A planner for a target at rest: an `nn.Module` or a plain callable.

    Reads the robot's state and ``goal`` from a tensordict, writes ``action`` and returns the same tensordict. Its
    memory between steps is in that tensordict under ``plan``; rows with ``step_count`` 0 restart.
    """

    def __call__(self, tensordict: TensorDictBase, /) -> TensorDictBase:
        """Write ``action`` (*B, A) for the robot's state and ``goal`` (*B, D)."""
        ...


def read(tensordict: TensorDictBase, key: NestedKey, reader: str) -> Tensor:
    """Entry ``key`` of ``tensordict``; raises `InputError`, naming ``reader``, if it is missing."""
    value = tensordict.get(key, None)
    if value is None:
        present = ", ".join(sorted(map(str, tensordict.keys()))) or "none"
        raise InputError(f"{reader} reads the key {key!r}, which the tensordict lacks; it has: {present}")
    return value


def keys_read(static: TensorDictModuleBase, *others: NestedKey) -> list[Any]:
    """Keys that a planner built on ``static`` reads: ``others`` and those of ``static`` except the goal, each once."""
    return list(dict.fromkeys([*others, *(key for key in static.in_keys if key not in (keys.GOAL, keys.GOAL_POSE))]))


def keys_written(static: TensorDictModuleBase, *others: NestedKey) -> list[Any]:
    """Keys that a planner built on ``static`` writes: ``others`` and those of ``static``, each once."""
    return list(dict.fromkeys([*others, *static.out_keys]))
