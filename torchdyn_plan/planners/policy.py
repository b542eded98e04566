"""A learned policy as a static planner."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.nets.policy import Actor
from torchdyn_plan.planners.approach import Approach, within_reach
from torchdyn_plan.planners.protocol import read
from torchdyn_plan.planners.rows import apply_to_rows

MEMORY_NAMES = ("policy_action", "policy_age", "policy_goal")


class PolicyPlanner(TensorDictModuleBase):
    """Static planner π_g(s^R): reads ``robot_state`` and ``goal``, writes ``action`` (paper, Section III-A).

    With a ``period`` above 1 an action holds for so many control steps, unless the goal changes; what it has to
    remember for that it keeps in the tensordict under ``plan``.
    """

    restless = True
    """Whether it goes on moving where it cannot get nearer to its goal."""

    def __init__(
        self, actor: nn.Module, *, period: int = 1, approach: Approach | None = None, chunk: int | None = None
    ) -> None:
        """Act by ``actor``.

        Args:
            actor: maps robot states ``(*B, S)`` and goals ``(*B, 3)`` [m, world] to actions ``(*B, A)``.
            period: control steps for which an action holds.
            approach: how far the tool reaches: a goal beyond, which the actor never saw, is brought to the edge. None
                to leave goals as they are.
            chunk: act in blocks of exactly this many rows, so that results do not depend on the batch size.
        """
        super().__init__()
        check_number("period", period, minimum=1, integer=True)
        if chunk is not None:
            check_number("chunk", chunk, minimum=1, integer=True)
        act: Any = actor
        self.actor, self.period, self.approach, self.chunk = act, period, approach, chunk
        seen: list[Any] = [keys.ROBOT_STATE, keys.GOAL]
        self.in_keys = seen + ([keys.STEP_COUNT] if period > 1 else [])
        written: list[Any] = [keys.ACTION]
        self.out_keys = written + ([(keys.PLAN, name) for name in MEMORY_NAMES] if period > 1 else [])

    @classmethod
    def from_pretrained(
        cls,
        name_or_path: str | Path = "trapper",
        *,
        period: int = 1,
        approach: Approach | None = None,
        chunk: int | None = None,
    ) -> PolicyPlanner:
        """Planner with the actor that ships under a name, or is in a file or folder; raises `WeightsError`.

        The one of the name ``trapper`` keeps within the reach of its arm.
        """
        approach = approach or (Approach() if str(name_or_path) == "trapper" else None)
        actor = Actor.from_pretrained(name_or_path).requires_grad_(False)
        return cls(actor, period=period, approach=approach, chunk=chunk)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (*B, A); raises `InputError` for a missing key, a wrong shape, or a NaN."""
        state, goal = (read(tensordict, key, "PolicyPlanner") for key in (keys.ROBOT_STATE, keys.GOAL))
        if self.approach is not None:
            goal = within_reach(goal, self.approach)
        if self.period == 1:
            tensordict.set(keys.ACTION, self._act(state, goal))
            return tensordict
        action, age = self._recall(tensordict, goal)
        action = torch.where((age == 0).unsqueeze(-1), self._act(state, goal), action)
        plan = tensordict.get(keys.PLAN, None)
        entries = {} if plan is None else dict(plan.items())
        entries.update(zip(MEMORY_NAMES, (action, (age + 1) % self.period, goal), strict=True))
        # A new one each step: tensordicts of earlier steps may share the old one.
        tensordict.set(keys.PLAN, TensorDict(entries, tensordict.batch_size, device=tensordict.device))
        tensordict.set(keys.ACTION, action)
        return tensordict

    def _act(self, state: Tensor, goal: Tensor) -> Tensor:
        if self.chunk is None:
            return self.actor(state, goal)
        every = torch.ones(goal.shape[:-1], dtype=torch.bool, device=goal.device)
        like = goal.new_zeros(*goal.shape[:-1], self.actor.config.action_size)
        return apply_to_rows(lambda *seen: (self.actor(*seen),), every, (state, goal), (like,), chunk=self.chunk)[0]

    def _recall(self, tensordict: TensorDictBase, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Action (*B, A) that holds and its age (*B,), 0 where a new one is due."""
        plan = tensordict.get(keys.PLAN, None)
        if plan is None or plan.get(MEMORY_NAMES[0], None) is None:
            size = self.actor.config.action_size
            return goal.new_zeros(*goal.shape[:-1], size), goal.new_zeros(goal.shape[:-1], dtype=torch.int64)
        action, age, old_goal = map(plan.get, MEMORY_NAMES)
        fresh = read(tensordict, keys.STEP_COUNT, "PolicyPlanner").reshape(age.shape) == 0
        return action, age.masked_fill(fresh | (old_goal != goal).any(-1), 0)
