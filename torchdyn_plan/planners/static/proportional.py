"""The trivial static planner of a tool that is pulled along x, y and z: straight at the goal, slower when near."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from torchdyn_plan import keys
from torchdyn_plan.checks import check_finite, check_number, check_trailing_shape
from torchdyn_plan.planners.protocol import read
from torchdyn_plan.planners.static.base import StaticPlannerModule


class ProportionalController(StaticPlannerModule):
    """Pulls the tool towards ``goal``: action = gain · (goal - tool), each axis cut to ±1.

    Reads ``tool_pos`` (*B, 3) and ``goal`` (*B, 3) [m, world], writes ``action`` (*B, ``action_size``), whose further
    entries are 0. It remembers nothing, and a row's action depends on that row alone, whatever the batch.
    """

    def __init__(self, *, gain: float, action_size: int = 3) -> None:
        """Pull with ``gain`` [1/m]; the first three of ``action_size`` entries are along x, y and z."""
        super().__init__()
        check_number("gain", gain, minimum=0.0)
        check_number("action_size", action_size, minimum=3, integer=True)
        self.gain, self.action_size = gain, action_size
        self.in_keys = [keys.TOOL_POS, keys.GOAL]
        self.out_keys = [keys.ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``; raises `InputError` where a key is missing, a shape is wrong or the goal holds a NaN."""
        tool_pos, goal = (read(tensordict, key, "ProportionalController") for key in self.in_keys)
        check_trailing_shape(keys.TOOL_POS, tool_pos, 3)
        check_trailing_shape(keys.GOAL, goal, 3)
        check_finite(keys.GOAL, goal)
        pull = ((goal - tool_pos) * self.gain).clamp(-1.0, 1.0)
        tensordict.set(keys.ACTION, torch.nn.functional.pad(pull, (0, self.action_size - 3)))
        return tensordict

    def part_settings(self) -> dict[str, Any]:
        """Arguments that make the same planner."""
        return {"gain": self.gain, "action_size": self.action_size}
