"""What planners and their parts look like from outside: anything of these shapes can be put in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError

if TYPE_CHECKING:
    from torchdyn_plan.nets.eta import Arrival
    from torchdyn_plan.planners.search import SearchResult


class StaticPlanner(Protocol):
    """A planner for a target at rest: an `nn.Module` or a plain callable.

    Reads the robot's state and ``goal`` from a tensordict, writes ``action`` and returns the same tensordict. What it
    has to remember between steps it keeps in that tensordict under ``plan``; rows with ``step_count`` 0 start afresh.
    """

    def __call__(self, tensordict: TensorDictBase, /) -> TensorDictBase:
        """Write ``action`` (*B, A) for the robot's state and ``goal`` (*B, 3)."""
        ...


class ArrivalPredictor(Protocol):
    """What tells how long a static planner needs to a goal; `torchdyn_plan.nets.ETANetwork` is one."""

    def arrival(self, robot_state: Tensor, goal: Tensor, *, reading: Any = ...) -> Arrival:
        """Steps and *never* (*B, K) for robot states (*B, 1, S) and goals (*B, K, 3)."""
        ...


class GoalSearch(Protocol):
    """A strategy that chooses where and when robot and target meet."""

    def __call__(self, forecast: Tensor, target_pos: Tensor, eta: Callable[..., Arrival], /) -> SearchResult:
        """Choose from forecast (*B, F, 3) and the target now (*B, 3); ``eta`` maps goals (*B, K, 3) to arrivals."""
        ...


def read(tensordict: TensorDictBase, key: NestedKey, reader: str) -> Tensor:
    """Entry ``key`` of ``tensordict``; raises `InputError` if ``reader`` is given a tensordict without it."""
    value = tensordict.get(key, None)
    if value is None:
        present = ", ".join(sorted(map(str, tensordict.keys()))) or "none"
        raise InputError(f"{reader} reads the key {key!r}, which the tensordict lacks; it has: {present}")
    return value


def keys_read(static: StaticPlanner, *others: NestedKey) -> list[Any]:
    """Keys that a planner built on ``static`` reads: ``others`` and those of ``static`` but the goal, each once."""
    return _once(others, (key for key in getattr(static, "in_keys", ()) if key != keys.GOAL))


def keys_written(static: StaticPlanner, *others: NestedKey) -> list[Any]:
    """Keys that a planner built on ``static`` writes: ``others`` and those of ``static``, each once."""
    return _once(others, getattr(static, "out_keys", (keys.ACTION,)))


def _once(first: Sequence[NestedKey], second: Iterable[NestedKey]) -> list[Any]:
    return list(dict.fromkeys([*first, *second]))
