"""Proportional controller as a static planner: straight to the goal, slower near it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from torchdyn_plan import keys
from torchdyn_plan.checks import POINT_SIZES, check_finite, check_number, check_points, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.protocol import read
from torchdyn_plan.planners.static.base import StaticPlannerModule


class ProportionalController(StaticPlannerModule):
    """Drives the tool towards ``goal``: action = gain · (goal - tool), each axis clamped to ±1.

    Reads ``tool_pos`` (*B, D) and ``goal`` (*B, D) [m, world], writes ``action`` (*B, ``action_size``), whose further
    entries are 0. It has no memory, and a row's action depends on that row only.
    """

    def __init__(self, *, gain: float, action_size: int | None = None) -> None:
        """Use ``gain`` [1/m]; the first D of ``action_size`` entries are the axes. None for ``action_size`` = D."""
        super().__init__()
        check_number("gain", gain, minimum=0.0)
        if action_size is not None:
            check_number("action_size", action_size, minimum=POINT_SIZES[0], integer=True)
        self.gain, self.action_size = gain, action_size
        self.in_keys = [keys.TOOL_POS, keys.GOAL]
        self.out_keys = [keys.ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``; raises `InputError` where a key is missing, a shape is wrong or the goal holds a NaN."""
        tool_pos, goal = (read(tensordict, key, "ProportionalController") for key in self.in_keys)
        size = check_points(keys.TOOL_POS, tool_pos)
        check_trailing_shape(keys.GOAL, goal, size)
        check_finite(keys.GOAL, goal)
        wide = size if self.action_size is None else self.action_size
        if wide < size:
            raise InputError(f"action_size must be at least the {size} coordinates of goal, got {wide}")
        pull = ((goal - tool_pos) * self.gain).clamp(-1.0, 1.0)
        tensordict.set(keys.ACTION, torch.nn.functional.pad(pull, (0, wide - size)))
        return tensordict

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this planner."""
        return {"gain": self.gain, "action_size": self.action_size}
