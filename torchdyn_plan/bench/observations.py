"""What planners see when they are timed: taken from a task's own environment, the same at every run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import DynamicPlanner, Observation, TargetPursuit
from torchdyn_plan.planners.observation import SEEN_BY_ALL
from torchdyn_plan.tasks.task import Task

EPISODES = 64
"""Episodes that are played for observations; larger batches repeat them."""
SPLIT = "dev"
"""Their series."""
PURSUED_STEPS = 13
"""Control steps for which a robot pursues its target before it is looked at."""


class Moments(NamedTuple):
    """What a planner sees at two moments, with its own memory in it; rows are episodes."""

    planning: TensorDict
    """When it plans for the first time, in every row."""
    between: TensorDict | None
    """At the next control step; None if it plans there, too."""

    def repeated(self, batch: int) -> Moments:
        """The same in ``batch`` rows."""
        return self._each(lambda seen: _repeated(seen, batch))

    def to(self, device: str) -> Moments:
        """The same on ``device``."""
        return self._each(lambda seen: seen.to(device))

    def _each(self, change: Callable[[TensorDict], TensorDict]) -> Moments:
        return Moments(change(self.planning), None if self.between is None else change(self.between))


def moments(task: Task, planner: Callable[[TensorDictBase], TensorDictBase], name: str = "planner") -> Moments:
    """What ``planner`` sees in `EPISODES` episodes of ``task`` at its default settings.

    Raises:
        InputError: it does not plan in all episodes at once before they end; ``name`` is whom the message names.
    """
    env = _make_env(task)
    with torch.no_grad():
        tensordict = env.reset()
        for _ in range(env.max_steps):
            planning = tensordict.copy()
            acted = planner(tensordict)
            if _replanned(acted).all():
                between = env.step_and_maybe_reset(acted)[1]
                again = _replanned(planner(between.copy())).any()
                return Moments(planning, None if again else between)
            tensordict = env.step_and_maybe_reset(acted)[1]
    raise InputError(f"{name} does not plan in all {EPISODES} episodes of {task.name} at once: it cannot be timed so")


def pursued(task: Task, batch: int) -> TensorDict:
    """``batch`` rows of what the static planner of ``task`` sees that has pursued its target for some steps."""
    env, planner = _make_env(task), TargetPursuit(task.static_planner())
    with torch.no_grad():
        tensordict = env.reset()
        for _ in range(PURSUED_STEPS):
            tensordict = env.step_and_maybe_reset(planner(tensordict))[1]
    # The goal has moved since the last step: what the static planner remembers leads elsewhere.
    return _repeated(tensordict.set(keys.GOAL, tensordict[keys.TARGET_POS]), batch)


def observe(planner: DynamicPlanner, seen: TensorDictBase) -> Observation:
    """What ``planner`` reads of ``seen``."""
    return Observation.of([seen[key] for key in (*SEEN_BY_ALL, *planner.forecaster.in_keys)])


def _make_env(task: Task) -> Any:
    return task.make_env(task.default_settings(), num_envs=EPISODES, seed=0, split=SPLIT, num_threads=1)


def _replanned(acted: TensorDictBase) -> Tensor:
    return acted.get((keys.PLAN, "replanned"))


def _repeated(rows: TensorDict, batch: int) -> TensorDict:
    return rows[torch.arange(batch) % len(rows)]
