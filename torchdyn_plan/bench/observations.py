"""What planners see when they are timed: taken from a task's own environment, the same at every run."""

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
"""Episodes that are played for observations; larger batches repeat them."""
SPLIT = "dev"
"""Their series."""
PURSUED_STEPS = 13
"""Control steps for which a robot pursues its target before it is looked at."""
LOOK_STEPS = 20
"""Control steps after all rows have planned in which a row is looked for that acts without a plan."""


class Moments(NamedTuple):
    """What a planner sees, with its own memory in it; rows are those of some episodes."""

    planning: TensorDict | None
    """Where it plans; None if it never does."""
    between: TensorDict | None
    """Where it acts without a plan; None if it plans at every step."""

    @property
    def first(self) -> TensorDict:
        """What it sees where it plans, or wherever it acts."""
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
    """What ``planner`` sees in `EPISODES` episodes of ``task`` at its default settings.

    Of a `DynamicPlanner` each row is taken where it plans first, and where it does not plan afterwards; of any other
    planner, which says of no step that it plans, after it has acted for some steps.

    Raises:
        InputError: it cannot act in the task; ``name`` is whom the message names.
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
    """Rows of what was seen, each taken once."""

    def __init__(self) -> None:
        self.taken = torch.zeros(EPISODES, dtype=torch.bool)
        self.pieces: list[TensorDict] = []

    @property
    def all_taken(self) -> bool:
        return bool(self.taken.all())

    def add(self, seen: TensorDict, rows: Tensor) -> None:
        """Take those of ``rows`` (E,) bool that are new."""
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
    """Step by step of at most an episode what ``planner`` sees, and the same after it acted.

    A planner for a static goal is sent to where the target is; the others set a goal of their own. One of another type
    of numbers sees them in its own.
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
    """The type of numbers of ``planner``; None if it has none or several."""
    tensors = [*planner.parameters(), *planner.buffers()] if isinstance(planner, nn.Module) else []
    found = {tensor.dtype for tensor in tensors if tensor.is_floating_point()}
    return found.pop() if len(found) == 1 else None


def _in_type(tensordict: Any, dtype: torch.dtype | None) -> Any:
    """The same with its numbers in ``dtype``, or as they are for None; what counts stays whole."""
    if dtype is None:
        return tensordict
    return tensordict.apply(lambda value: value.to(dtype) if value.is_floating_point() else value)


def _future(task: Task, planner: Planner) -> Tensor | None:
    """Where the targets of the episodes go, ``(E, T, 3)`` [m, world], for a planner that reads it."""
    if not keys.TRUTHS & set(getattr(planner, "in_keys", ())):
        return None
    truth = find_truth(task, task.default_settings(), episodes=EPISODES, seed=0, split=SPLIT, num_threads=1)
    return truth.future if truth.future.shape[1] else None


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
    return planners.observe(seen, planner.forecaster)


def _make_env(task: Task) -> Any:
    return task.make_env(task.default_settings(), num_envs=EPISODES, seed=0, split=SPLIT, num_threads=1)


def _replanned(acted: TensorDictBase) -> Tensor:
    return acted.get((keys.PLAN, "replanned"))


def _repeated(rows: TensorDict, batch: int) -> TensorDict:
    return rows[torch.arange(batch) % len(rows)]
