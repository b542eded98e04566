"""Observations for timing planners: taken from a task's own environment, the same in every run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchdyn_plan import keys, planners
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.episodes import Planner, ShownTruth, find_truth
from torchdyn_plan.planners import DynamicPlanner, Observation, TargetPursuit
from torchdyn_plan.planners.memory import Remembering
from torchdyn_plan.tasks.task import Task

EPISODES = 64
"""Episodes played for observations; larger batches repeat them."""
SPLIT = "dev"
"""Split of these episodes."""
PURSUED_STEPS = 13
"""Control steps for which a robot pursues its target before its observation is taken."""
LOOK_STEPS = 20
"""Control steps, after all rows have planned, in which a step without a plan is searched for."""


class Moments(NamedTuple):
    """A planner's inputs, including its memory; rows come from different episodes."""

    planning: TensorDict | None
    """Inputs at steps that plan; None if there are none."""
    between: TensorDict | None
    """Inputs at steps that do not plan; None if it plans at every step."""

    @property
    def first(self) -> TensorDict:
        """Inputs of a step that plans, or else of any step."""
        seen: Any = self.between if self.planning is None else self.planning
        return seen

    def repeated(self, batch: int) -> Moments:
        """The same in ``batch`` rows."""
        return self._each(lambda seen: _repeated(seen, batch))

    def to(self, device: str) -> Moments:
        """The same on ``device``."""
        return self._each(lambda seen: seen.to(device))

    def _each(self, change: Callable[[TensorDict], TensorDict]) -> Moments:
        return Moments(*(None if seen is None else change(seen) for seen in self))


def moments(task: Task, planner: Planner, name: str = "planner") -> Moments:
    """Inputs of ``planner`` in `EPISODES` episodes of ``task`` at its default settings.

    For a `DynamicPlanner` each row is taken at its first plan, and at a later step without a plan; for any other
    planner, after it has acted for some steps.

    Raises:
        InputError: it cannot act in the task; the message names it ``name``.
    """
    env, future = _make_env(task), _future(task, planner)
    plans = isinstance(planner, DynamicPlanner)
    planning, between, waited = _Rows(), _Rows(), 0
    seen = None
    try:
        with torch.no_grad():
            for step, (seen, acted) in enumerate(_play(env, planner, future)):
                if not plans:
                    if step >= PURSUED_STEPS:
                        break
                    continue
                now = _replanned(acted)
                between.add(seen, ~now & planning.taken)
                planning.add(seen, now)
                waited += planning.all_taken
                if planning.all_taken and (between.all_taken or waited > LOOK_STEPS):
                    break
    except Exception as error:
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"planner {name!r} cannot act in {task.name}: {reason}") from error
    if not planning.pieces:
        return Moments(None, seen)
    return Moments(planning.joined(), between.joined() if between.pieces else None)


class _Rows:
    """Rows of inputs, each taken once."""

    def __init__(self) -> None:
        self.taken = torch.zeros(EPISODES, dtype=torch.bool)
        self.pieces: list[TensorDict] = []

    @property
    def all_taken(self) -> bool:
        return bool(self.taken.all())

    def add(self, seen: TensorDict, rows: Tensor) -> None:
        """Add the new ones of ``rows`` (E,) bool."""
        new = rows & ~self.taken
        if new.any():
            self.pieces.append(seen if new.all() else seen[new])
            self.taken |= new

    def joined(self) -> TensorDict:
        """All rows, with the entries that all of them have."""
        if len(self.pieces) == 1:
            return self.pieces[0]
        shared = set.intersection(*(set(piece.keys(include_nested=True, leaves_only=True)) for piece in self.pieces))
        joined: Any = TensorDict.cat([piece.select(*shared) for piece in self.pieces])
        return joined


def _play(env: Any, planner: Planner, future: Tensor | None) -> Iterator[tuple[TensorDict, TensorDictBase]]:
    """The inputs of ``planner`` and its outputs, step by step for at most an episode.

    A planner for a static goal gets the target's position as its goal; the others set their own. Inputs are converted
    to the planner's dtype.
    """
    tensordict, (dtype, own) = env.reset(), (torch.get_default_dtype(), _dtype(planner))
    truth = ShownTruth(planner, env, future)
    if isinstance(planner, Remembering):
        memory = planner.empty_memory(tensordict[keys.TOOL_POS])
        tensordict[keys.PLAN] = TensorDict(memory, tensordict.batch_size)
    for _ in range(env.max_steps):
        tensordict[keys.GOAL] = tensordict[keys.TARGET_POS].clone()
        truth.show(tensordict)
        tensordict = _in_type(tensordict, own)
        seen = tensordict.copy()
        acted = planner(tensordict)
        yield seen, acted
        tensordict = env.step_and_maybe_reset(_in_type(acted, own and dtype))[1]


def _dtype(planner: Planner) -> torch.dtype | None:
    """The dtype of ``planner``; None if it has none or several."""
    tensors = [*planner.parameters(), *planner.buffers()] if isinstance(planner, nn.Module) else []
    found = {tensor.dtype for tensor in tensors if tensor.is_floating_point()}
    return found.pop() if len(found) == 1 else None


def _in_type(tensordict: Any, dtype: torch.dtype | None) -> Any:
    """The tensordict with floating-point entries in ``dtype``, unchanged for None."""
    if dtype is None:
        return tensordict
    return tensordict.apply(lambda value: value.to(dtype) if value.is_floating_point() else value)


def _future(task: Task, planner: Planner) -> Tensor | None:
    """Future positions of the targets, ``(E, T, 3)`` [m, world], for a planner that reads them."""
    if not keys.TRUTHS & set(getattr(planner, "in_keys", ())):
        return None
    truth = find_truth(task, task.default_settings(), episodes=EPISODES, seed=0, split=SPLIT, num_threads=1)
    return truth.future if truth.future.shape[1] else None


def pursued(task: Task, batch: int) -> TensorDict:
    """``batch`` rows of inputs of the static planner of ``task``, after it has pursued its target for some steps."""
    env, planner = _make_env(task), TargetPursuit(task.static_planner())
    with torch.no_grad():
        tensordict = env.reset()
        for _ in range(PURSUED_STEPS):
            tensordict = env.step_and_maybe_reset(planner(tensordict))[1]
    # The goal has moved since the last step, so the static planner's memory leads elsewhere.
    return _repeated(tensordict.set(keys.GOAL, tensordict[keys.TARGET_POS]), batch)


def observe(planner: DynamicPlanner, seen: TensorDictBase) -> Observation:
    """What ``planner`` reads of ``seen``."""
    return planners.observe(seen, planner.forecaster)


def _make_env(task: Task) -> Any:
    return task.make_env(task.default_settings(), num_envs=EPISODES, seed=0, split=SPLIT, num_threads=1)


def _replanned(acted: TensorDictBase) -> Tensor:
    return acted.get((keys.PLAN, "replanned"))


def _repeated(rows: TensorDict, batch: int) -> TensorDict:
    return rows[torch.arange(batch) % len(rows)]
