"""Speed of Reach compared with gymnasium-robotics' FetchReach under the same actions, and how far they differ.

The original is patched as in the tests (its helpers fail with mujoco 3.17 and later) and runs its copies one after
another in Gymnasium's `SyncVectorEnv`.

python benchmarks/reach_env.py --out benchmarks/results/reach_env.json
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro
from gymnasium.vector import SyncVectorEnv
from study import Output, Row, Study, each, measuring

from tests.envs.fetch_reach.fetch_original import original_fetch_reach
from torchdyn_plan import keys
from torchdyn_plan.envs import DynamicReachEnv, FetchSimulation
from torchdyn_plan.tasks import load_task
from torchdyn_plan.versions import usable_cores

ORIGINAL = "FetchReach, SyncVectorEnv"
OURS = "DynamicReachEnv"
PHYSICS = "FetchSimulation: MuJoCo alone"
BLOCK = 8
"""Steps of one implementation before it is the next one's turn."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Measure."""

    copies: int = 64
    """Environments side by side."""
    steps: int = 40
    """Steps of each, in turn."""
    threads: tuple[int, ...] = (1, 0)
    """Threads of ours, 0 for all cores."""


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """What ``function`` returns, and how long it takes [s]."""
    started = time.perf_counter()
    result = function()
    return result, time.perf_counter() - started


def measure(arguments: Arguments, threads: int) -> tuple[dict[str, list[float]], float]:
    """Durations of the steps [s] of the original, of ours on so many threads, and of the physics of both alone.

    Each makes `BLOCK` steps before the next one does: the copies of one would throw the other's out of the cache. Also
    returned is the greatest difference between what the original and ours observe.
    """
    copies = arguments.copies
    theirs, ours = SyncVectorEnv([original_fetch_reach] * copies), DynamicReachEnv(copies, num_threads=threads)
    theirs.reset(seed=0)
    td, error, arms = ours.reset(), 0.0, FetchSimulation(copies, num_threads=threads)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (arguments.steps, copies, 4)).astype(np.float32)
    times: dict[str, list[float]] = {name: [] for name in (ORIGINAL, OURS, PHYSICS)}
    for block in each(np.split(actions, range(BLOCK, len(actions), BLOCK)), f"{threads} threads"):
        seen = []
        for action in block:
            (observed, *_), taken = timed(lambda action=action: theirs.step(action))
            seen.append(observed["observation"])
            times[ORIGINAL].append(taken)
        for action, expected in zip(block, seen, strict=True):
            td[keys.ACTION] = torch.from_numpy(action)
            (stepped, td), taken = timed(lambda td=td: ours.step_and_maybe_reset(td))
            times[OURS].append(taken)
            state = stepped["next", keys.OBSERVATION].numpy()
            error = max(error, float(np.abs(state - expected).max()))
        for action in torch.from_numpy(block):
            times[PHYSICS].append(timed(lambda action=action: arms.step(action))[1])
    return times, error


def rows_of(arguments: Arguments, threads: int) -> list[Row]:
    """A row for each implementation."""
    times, error = measure(arguments, threads)
    medians = {name: statistics.median(taken) for name, taken in times.items()}
    return [
        {
            "what": "step",
            "implementation": name,
            "batch": arguments.copies,
            "compiled": False,
            "device": "cpu",
            "threads": 1 if name == ORIGINAL else threads or usable_cores(),
            "median_us": 1e6 * median,
            "per_item_us": 1e6 * median / arguments.copies,
            "env_steps_per_second": arguments.copies / median,
            "times_the_original": medians[ORIGINAL] / median,
            "max_error": error if name == OURS else None,
        }
        for name, median in medians.items()
    ]


def main(arguments: Arguments) -> None:
    """Measure, save and print; what the file held before is replaced, as timings of one run belong together."""
    study = Study(arguments, scene=load_task("fetch_reach").digest(), resume=False)
    with measuring():
        for threads in arguments.threads:
            for row in rows_of(arguments, threads):
                study.add(row)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
