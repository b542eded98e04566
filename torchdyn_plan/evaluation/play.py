"""The loop of an evaluation: environment, planner, log, whatever the task."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.moving_target import MovingTargetEnv
from torchdyn_plan.evaluation.planners import Planner


class Log(Protocol):
    """What has happened in episodes 0 … E-1 so far."""

    @property
    def done(self) -> Tensor:
        """Which episodes have ended, ``(E,)`` bool."""
        ...

    def add(self, stepped: TensorDictBase) -> int:
        """Take in one step of all environments; returns how many episodes it ended. What comes later does not count."""
        ...


def play(planner: Planner, env: MovingTargetEnv, log: Log, future: Tensor | None = None) -> Iterator[int]:
    """Step all environments once for each value taken, which is the number of ``log``'s episodes that the step ended.

    ``future`` (E, T, 3) is the recorded truth for planners that read ``target_future``.
    """
    if keys.TARGET_FUTURE not in getattr(planner, "in_keys", ()):
        future = None
    tensordict = env.reset()
    while True:
        if future is not None:
            tensordict[keys.TARGET_FUTURE] = future[tensordict[keys.EPISODE].clamp(max=len(future) - 1)]
        stepped, tensordict = env.step_and_maybe_reset(planner(tensordict))
        yield log.add(stepped)


def play_all(planner: Planner, env: MovingTargetEnv, log: Log, future: Tensor, *, name: str) -> float:
    """Play until all of ``log``'s episodes have ended; an environment takes the next episode when its own ends.

    Args:
        planner: any planner for a moving target.
        env: what it acts in, at its first episode.
        log: of the episodes to come.
        future: ``(E, T, 3)`` recorded truth, shown to planners that read ``target_future``.
        name: shown beside the progress bar.

    Returns:
        How long it took [s].
    """
    from tqdm import tqdm

    count, started = len(log.done), time.perf_counter()
    with torch.no_grad(), tqdm(total=count, desc=name, unit="episode", leave=False) as bar:
        for ended in play(planner, env, log, future):
            bar.update(ended)
            if bar.n >= count:
                break
    return time.perf_counter() - started


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: networks this small are fastest on one thread, which leaves the cores to the simulation."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
