"""Step-by-step records of episodes that run in parallel."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys


class Trace(NamedTuple):
    """Records of R episodes at control steps 0 … T-1; values after an episode's end are arbitrary."""

    tool_pos: Tensor
    """``(R, T, D)`` [m, world]"""
    target_pos: Tensor
    """``(R, T, D)`` [m, world]"""
    goal: Tensor
    """``(R, T, D)`` goal of the plan in use, or of the static planner if there are no plans [m, world]."""
    arrival_steps: Tensor
    """``(R, T)`` int64 control steps to the meeting."""
    planned: Tensor
    """``(R, T)`` bool: a plan was made at this step."""
    reachable: Tensor
    """``(R, T)`` bool: the robot can be in time for the meeting, according to the plan in use."""
    length: Tensor
    """``(R,)`` int64: the step at which the episode ended."""
    joint_speed: Tensor
    """``(R, T)`` speed of the fastest joint [rad/s]; 0 for a robot without joints."""


PLACES, NUMBERS = 3, 4
"""Positions and single numbers recorded at each step: the fields of `Trace` except the length."""


class TraceLog:
    """Records what environments and planner write; each environment's row restarts with its next episode."""

    def __init__(self, max_steps: int) -> None:
        """Room for episodes of up to ``max_steps`` control steps."""
        self._max_steps = max_steps
        self._record: Tensor = torch.empty(0, max_steps + 1, 0)
        self._ended: list[Tensor] = []
        self._lengths: list[Tensor] = []

    def add(self, stepped: TensorDictBase) -> None:
        """Add one step of all environments, before the action takes effect."""
        tool_pos: Tensor = stepped.get(keys.TOOL_POS)
        step: Tensor = stepped.get(keys.STEP_COUNT).squeeze(-1)
        if len(self._record) != len(step):
            self._record = torch.empty(len(step), self._max_steps + 1, PLACES * tool_pos.shape[-1] + NUMBERS)
            self._rows = torch.arange(len(step))
        plan = stepped.get(keys.PLAN, None)
        if plan is None or plan.get("replanned", None) is None:
            goal, numbers = stepped.get(keys.GOAL, None), torch.zeros(len(step), 3)
            goal = tool_pos if goal is None else goal
        else:
            goal, *numbers = map(plan.get, ("goal", "arrival_steps", "replanned", "reachable"))
            numbers = torch.stack(numbers, dim=-1)
        # Of a goal with an orientation only the position is kept.
        entries = torch.cat([*_shown(stepped), goal[..., : tool_pos.shape[-1]], numbers], dim=-1)
        self._record[self._rows, step] = entries.to(self._record.dtype)

    def end(self, stepped: TensorDictBase, rows: Tensor) -> None:
        """Store the episodes of environments ``rows`` (R,), which end with this step."""
        after: TensorDictBase = stepped.get("next")
        length = after[keys.STEP_COUNT].squeeze(-1)[rows]
        record = self._record[rows]
        last = torch.cat(_shown(after), dim=-1)[rows]
        record[torch.arange(len(rows)), length, : last.shape[-1]] = last.to(record.dtype)
        self._ended.append(record)
        self._lengths.append(length)

    def traces(self, block: int = 256) -> list[Trace]:
        """The stored episodes, in the order in which they ended, ``block`` at a time."""
        if not self._ended:
            return []
        records, lengths = torch.cat(self._ended), torch.cat(self._lengths)
        return [
            _split(record, length) for record, length in zip(records.split(block), lengths.split(block), strict=True)
        ]


def _shown(observed: TensorDictBase) -> list[Tensor]:
    """Positions of robots and targets, (N, D) each, and the speed of the fastest joint (N, 1)."""
    tool_pos: Tensor = observed.get(keys.TOOL_POS)
    joint_vel = observed.get(keys.JOINT_VEL, None)
    speed = torch.zeros_like(tool_pos[:, :1]) if joint_vel is None else joint_vel.abs().amax(-1, keepdim=True)
    return [tool_pos, true_target(observed), speed]


def true_target(tensordict: TensorDictBase) -> Tensor:
    """True positions of the targets, ``(*B, D)`` [m, world], unaffected by the sensor."""
    truth = tensordict.get(keys.TRUE_TARGET_POS, None)
    return tensordict[keys.TARGET_POS] if truth is None else truth


def _split(record: Tensor, length: Tensor) -> Trace:
    size = (record.shape[-1] - NUMBERS) // PLACES
    tool_pos, target_pos, *others = record.split([size, size, 1, size, 1, 1, 1], dim=-1)
    speed, goal, arrival, planned, reachable = (others[0].squeeze(-1), others[1], *(o.squeeze(-1) for o in others[2:]))
    return Trace(tool_pos, target_pos, goal, arrival.long(), planned > 0, reachable > 0, length, speed)
