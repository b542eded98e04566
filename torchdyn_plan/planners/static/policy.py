"""A learned policy as a static planner."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.nets.policy import Actor
from torchdyn_plan.planners.memory import remember, warn_of_loss
from torchdyn_plan.planners.protocol import read
from torchdyn_plan.planners.rows import apply_to_rows
from torchdyn_plan.planners.static.approach import Approach
from torchdyn_plan.planners.static.base import StaticPlannerModule


class Held(NamedTuple):
    """An action held for some steps; its names under ``plan`` begin with ``policy_``."""

    action: Tensor
    """``(*B, A)``."""
    age: Tensor
    """``(*B,)`` int64 control steps for which it has been held, 0 when a new one is due."""
    goal: Tensor
    """``(*B, 3)`` for which it was chosen [m, world]."""


HELD_NAMES = tuple(f"policy_{field}" for field in Held._fields)


class PolicyPlanner(StaticPlannerModule):
    """Static planner π_g(s^R): reads ``robot_state`` and ``goal``, writes ``action`` (paper, Section III-A).

    With a ``period`` above 1 an action is held for that many control steps, unless the goal changes; the memory for
    this is in the tensordict under ``plan``.
    """

    comes_to_rest = False

    def __init__(
        self, actor: nn.Module, *, period: int = 1, approach: Approach | None = None, chunk: int | None = None
    ) -> None:
        """Act by ``actor``.

        Args:
            actor: maps robot states ``(*B, S)`` and goals ``(*B, 3)`` [m, world] to actions ``(*B, A)``.
            period: control steps for which an action is held.
            approach: gives the tool's reach: a goal beyond it, which the actor was not trained on, is moved to the
                edge. None to leave goals unchanged.
            chunk: act in blocks of exactly this many rows, so that results do not depend on the batch size.
        """
        super().__init__()
        check_number("period", period, minimum=1, integer=True)
        if chunk is not None:
            check_number("chunk", chunk, minimum=1, integer=True)
        act: Any = actor
        self.actor, self.period, self.approach, self.chunk = act, period, approach, chunk
        remembered: list[Any] = [(keys.PLAN, name) for name in HELD_NAMES] if period > 1 else []
        self.in_keys = [keys.ROBOT_STATE, keys.GOAL, *([keys.STEP_COUNT] if period > 1 else []), *remembered]
        self.out_keys = [keys.ACTION, *remembered]

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path, **settings: Any) -> PolicyPlanner:
        """Planner with a shipped actor, or one from a file or folder; raises `WeightsError`.

        ``settings`` are arguments of the constructor.
        """
        return cls(Actor.from_pretrained(name_or_path).requires_grad_(False), **settings)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (*B, A); raises `InputError` for a missing key, a wrong shape, or a NaN."""
        state, goal = (read(tensordict, key, "PolicyPlanner") for key in (keys.ROBOT_STATE, keys.GOAL))
        if self.approach is not None:
            goal = self.approach.within_reach(goal)
        if self.period == 1:
            tensordict.set(keys.ACTION, self._act(state, goal))
            return tensordict
        action, age = self._recall(tensordict, goal)
        action = torch.where((age == 0).unsqueeze(-1), self._act(state, goal), action)
        held = Held(action, (age + 1) % self.period, goal)
        remember(tensordict, dict(zip(HELD_NAMES, held, strict=True)))
        tensordict.set(keys.ACTION, action)
        return tensordict

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """The entries of rows without a held action, see `Remembering`."""
        if self.period == 1:
            return {}
        action = like.new_zeros(*like.shape[:-1], self.actor.config.action_size)
        age = torch.zeros(like.shape[:-1], dtype=torch.int64, device=like.device)
        return dict(zip(HELD_NAMES, Held(action, age, torch.zeros_like(like)), strict=True))

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this planner."""
        return {name: getattr(self, name) for name in ("actor", "period", "approach", "chunk")}

    def _act(self, state: Tensor, goal: Tensor) -> Tensor:
        if self.chunk is None:
            return self.actor(state, goal)
        every = torch.ones(goal.shape[:-1], dtype=torch.bool, device=goal.device)
        like = goal.new_zeros(*goal.shape[:-1], self.actor.config.action_size)
        return apply_to_rows(lambda *seen: (self.actor(*seen),), every, (state, goal), (like,), chunk=self.chunk)[0]

    def _recall(self, tensordict: TensorDictBase, goal: Tensor) -> tuple[Tensor, Tensor]:
        """The held action (*B, A) and its age (*B,), 0 where a new one is due."""
        plan = tensordict.get(keys.PLAN, None)
        stored: dict[str, Any] = {} if plan is None else dict(plan.items())
        fresh = read(tensordict, keys.STEP_COUNT, "PolicyPlanner").reshape(goal.shape[:-1]) == 0
        if any(name not in stored for name in HELD_NAMES):
            warn_of_loss(HELD_NAMES[0], fresh)
            empty = self.empty_memory(goal)
            return empty[HELD_NAMES[0]], empty[HELD_NAMES[1]]
        held = Held(*(stored[name] for name in HELD_NAMES))
        return held.action, held.age.masked_fill(fresh | (held.goal != goal).any(-1), 0)
