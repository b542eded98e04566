"""How fast Reach runs beside gymnasium-robotics' FetchReach, the same actions in turn, and how far they differ.

The original is mended as in the tests (its helpers fail with mujoco 3.17 and later) and runs its copies one after the
other in Gymnasium's `SyncVectorEnv`.

python benchmarks/reach_env.py --out benchmarks/results/reach_env.json
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from gymnasium.vector import SyncVectorEnv
from tqdm import tqdm

from tests.envs.fetch_original import original_fetch_reach
from torchdyn_plan import keys
from torchdyn_plan.envs import DynamicReachEnv
from torchdyn_plan.envs.fetch import FetchSimulation
from torchdyn_plan.files import write_json
from torchdyn_plan.versions import library_versions, machine, usable_cores

ORIGINAL = "FetchReach, SyncVectorEnv"
PHYSICS = "FetchSimulation: MuJoCo alone"
BLOCK = 8
"""Steps of one implementation before it is the next one's turn."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Measure."""

    copies: int = 64
    """Environments side by side."""
    steps: int = 40
    """Steps of each, in turn."""
    threads: tuple[int, ...] = (1, 0)
    """Threads of ours, 0 for all cores."""
    out: Path | None = None
    """JSON file for the figures."""


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """What ``function`` returns, and how long it takes [s]."""
    started = time.perf_counter()
    result = function()
    return result, time.perf_counter() - started


def measure(arguments: Arguments, threads: int) -> list[dict[str, Any]]:
    """A row for the original, one for ours on so many threads, and one for the physics of both and nothing else.

    Each makes `BLOCK` steps before the next one does: the copies of one would throw the other's out of the cache.
    """
    copies = arguments.copies
    theirs, ours = SyncVectorEnv([original_fetch_reach] * copies), DynamicReachEnv(copies, num_threads=threads)
    theirs.reset(seed=0)
    td, error, arms = ours.reset(), 0.0, FetchSimulation(copies, num_threads=threads)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (arguments.steps, copies, 4)).astype(np.float32)
    times: dict[str, list[float]] = {name: [] for name in (ORIGINAL, "DynamicReachEnv", PHYSICS)}
    blocks = np.split(actions, range(BLOCK, len(actions), BLOCK))
    for block in tqdm(blocks, desc=f"{threads} threads", unit="block", leave=False):
        seen = []
        for action in block:
            (observed, *_), taken = timed(lambda action=action: theirs.step(action))
            seen.append(observed["observation"])
            times[ORIGINAL].append(taken)
        for action, expected in zip(block, seen, strict=True):
            td[keys.ACTION] = torch.from_numpy(action)
            (stepped, td), taken = timed(lambda td=td: ours.step_and_maybe_reset(td))
            times["DynamicReachEnv"].append(taken)
            state = stepped["next", keys.OBSERVATION].numpy()
            error = max(error, float(np.abs(state - expected).max()))
        for action in torch.from_numpy(block):
            times[PHYSICS].append(timed(lambda action=action: arms.step(action))[1])
    slowest = statistics.median(times[ORIGINAL])
    rows = []
    for name, taken in times.items():
        median = statistics.median(taken)
        rows.append(
            {
                "what": "step", "implementation": name, "batch": copies, "compiled": False, "device": "cpu",
                "threads": 1 if name == ORIGINAL else threads or usable_cores(), "median_us": 1e6 * median,
                "per_item_us": 1e6 * median / copies, "env_steps_per_second": copies / median,
                "times_the_original": slowest / median, "max_error": error if name == "DynamicReachEnv" else None,
            }
        )  # fmt: skip
    return rows


def main(arguments: Arguments) -> None:
    """Measure, print and write."""
    torch.set_num_threads(1)
    rows = [row for threads in arguments.threads for row in measure(arguments, threads)]
    for row in rows:
        told = {name: round(value, 6) if isinstance(value, float) else value for name, value in row.items()}
        print("  ".join(f"{name} {value}" for name, value in told.items()))
    if arguments.out is not None:
        config = asdict(arguments) | {"out": str(arguments.out)}
        about = {"config": config, "machine": machine(), "versions": library_versions()}
        write_json(arguments.out, about | {"rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
