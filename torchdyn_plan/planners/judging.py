"""Checks a planner's input row by row, at steps at which some value is bad."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.func import debug_unwrap

from torchdyn_plan import keys
from torchdyn_plan.checks import hides_values
from torchdyn_plan.planners.observation import Observation

LARGEST = 1e6
"""A value above this is bad, in its units [m, rad, s]."""


class Judgement(NamedTuple):
    """Rows with a value that is NaN, infinite or too large; None if every row is good."""

    blind: Tensor | None = None
    """``(*B,)`` bool: the robot state, or the memory of its static planner, is bad."""
    bad_input: Tensor | None = None
    """``(*B,)`` bool: a value of the robot or of the target is bad."""
    spoiled: Tensor | None = None
    """``(*B,)`` bool: the planner's memory is bad."""


GOOD = Judgement()
"""The judgement of a step in which every row is good."""


def judge(
    observation: Observation, tensordict: TensorDictBase, read_by_static: Sequence[Any], remembered: Sequence[str]
) -> tuple[Observation, Judgement]:
    """Check everything that a planner reads.

    Args:
        observation: the planner's observation.
        tensordict: the tensordict it was read from.
        read_by_static: further keys that the static planner reads; absent ones are skipped.
        remembered: names of the planner's memory under ``plan``.

    Returns:
        The observation with zeros in bad rows, so that computing with them stays finite, and the judgement.
    """
    target = [observation.target_pos, *observation.seen]
    plan = _stored(tensordict)
    robot = [observation.tool_pos, observation.robot_state, *_present(tensordict, plan, read_by_static)]
    memory = [plan[name] for name in remembered if name in plan]
    batch = observation.tool_pos.shape[:-1]
    blind, unseen, spoiled = (bad_rows(values, batch) for values in (robot, target, memory))
    clean = observation._replace(
        tool_pos=_zero(observation.tool_pos, blind),
        robot_state=_zero(observation.robot_state, blind),
        target_pos=_zero(observation.target_pos, unseen),
        seen=tuple(_zero(value, unseen) for value in observation.seen),
    )
    return clean, Judgement(blind, blind | unseen, spoiled)


def judge_rows(tensordict: TensorDictBase, read: Sequence[Any], batch: torch.Size) -> Tensor:
    """`bad_rows` for the keys ``read``; absent ones are skipped."""
    return bad_rows(_present(tensordict, _stored(tensordict), read), batch)


def bad_rows(values: Sequence[Tensor], batch: torch.Size) -> Tensor:
    """Rows ``(*B,)`` bool in which some of ``values`` (*B, …) is NaN, infinite or above `LARGEST`."""
    bad = torch.zeros(batch, dtype=torch.bool)
    for value in values:
        if value.is_floating_point():
            rows = value.reshape(*batch, value.shape[len(batch) :].numel())
            bad = bad.to(value.device) | ~(rows.abs() <= LARGEST).all(-1)
    return bad


def act(static: Any, tensordict: TensorDictBase, blind: Tensor) -> TensorDictBase:
    """Run the ``static`` planner; rows that are ``blind`` (*B,) get action 0.

    It sees zeros there, in a copy, so its inputs stay unchanged. Goals that are NaN or infinite become 0.
    """
    goal = tensordict.get(keys.GOAL)
    tensordict.set(keys.GOAL, _zero(goal, bad_rows([goal], goal.shape[:-1])))
    copy = tensordict.copy()
    for key in static.in_keys:
        value = tensordict.get(key, None)
        if isinstance(value, Tensor):
            copy.set(key, _zero(value, blind))
    acted = static(copy)
    tensordict.update(acted.exclude(*(key for key in static.in_keys if key not in static.out_keys)))
    return tensordict.set(keys.ACTION, _zero(acted.get(keys.ACTION), blind))


def _stored(tensordict: TensorDictBase) -> dict[str, Any]:
    """The entries under ``plan`` as a plain dictionary: a nested look-up costs as much as a tensor operation."""
    plan = tensordict.get(keys.PLAN, None)
    return {} if plan is None else dict(plan.items())


def _present(tensordict: TensorDictBase, plan: dict[str, Any], read: Sequence[Any]) -> list[Tensor]:
    """The values of the keys ``read`` of a tensordict with ``plan`` in it; absent ones are skipped."""
    found = (tensordict.get(key, None) if isinstance(key, str) else plan.get(key[-1]) for key in read)
    return [value for value in found if value is not None]


def _zero(value: Tensor, rows: Tensor) -> Tensor:
    """``value`` (*B, …) with 0 in ``rows`` (*B,)."""
    if not value.is_floating_point() or not (hides_values(rows) or debug_unwrap(rows).any()):
        return value
    return value.masked_fill(rows[(..., *[None] * (value.ndim - rows.ndim))], 0.0)
