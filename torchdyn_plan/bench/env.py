"""How much of MuJoCo's rate is left when TorchRL and a planner are in the loop: both measured in turn, on one tape."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from mujoco.batch import Batch
from tensordict import TensorDictBase

from torchdyn_plan import keys
from torchdyn_plan.bench.record import Record, Row
from torchdyn_plan.bench.tape import RawSimulation, TapedBatch, duration
from torchdyn_plan.bench.timing import figures
from torchdyn_plan.envs.moving_target import MovingTargetEnv
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.episodes import EpisodeLog, Planner, play
from torchdyn_plan.progress import progress_bar
from torchdyn_plan.tasks import DEFAULT, Task, load_task
from torchdyn_plan.threads import one_thread
from torchdyn_plan.versions import usable_cores

SIZES = (64, 256, 2048)
"""Environments side by side."""
STEPS = 500
"""Control steps of each measurement."""
BLOCK = 50
"""Control steps after which the loop and MuJoCo alone take turns."""
PLANNERS = ("pursuit", "corner")
"""Planners that are in the loop when none are given, if the task has them."""
SPLIT = "dev"
"""Series of episodes."""
RANDOM = "random"
"""The environment alone, under random actions."""
RANDOM_ACTIONS = 64
"""Actions that are drawn; then they are repeated."""


def bench(
    task: Task | str = DEFAULT,
    *,
    planners: Mapping[str, Planner] | Sequence[str] | None = None,
    sizes: Sequence[int] = SIZES,
    steps: int = STEPS,
    threads: int = 0,
    out: str | Path | None = None,
    progress: bool = True,
    show: Callable[[Row], object] | None = None,
) -> list[Row]:
    """A row for MuJoCo alone and one for the loop around it, for each size and each way of driving the robots.

    ``share_of_raw`` is MuJoCo's time over the loop's for the same commands; ``max_error`` compares their positions.

    Args:
        task: at its default settings; the simulation of its environment must be a MuJoCo batch.
        planners: planners by name, or names of the task's; for None `PLANNERS`, or all default ones without them.
        sizes: environments side by side.
        steps: control steps of each measurement.
        threads: of the simulation, 0 for all cores.
        out: JSON file for the rows, written with each of them.
        progress: show a progress bar.
        show: is given each row once it is measured and saved.

    Raises:
        InputError: the environment has no ``simulation.batch`` that is a `mujoco.batch.Batch`.
        OutputError: the file cannot be written.
    """
    task = load_task(task)
    about = {"task": task.name, "sizes": list(sizes), "steps": steps, "threads": threads}
    record = Record(out, show=show, benchmark="env", **about)
    drivers = _planners(task, planners)
    bar = progress_bar(
        total=len(sizes) * (1 + len(drivers)) * steps, desc="env", unit="step", leave=False, disable=not progress
    )
    with one_thread(), torch.no_grad(), bar:
        for size in sizes:
            for what in (RANDOM, *drivers):
                env, taped = taped_env(task, size, threads)
                if what == RANDOM:
                    loop = _random(env)
                else:
                    loop = play(drivers[what], env, EpisodeLog.empty(10 * size, task, env))
                raw, taken, error = _take_turns(loop, taped, steps, bar.update)
                for row in _rows(what, env, raw, taken, error):
                    record.add(row)
    return record.end()


def taped_env(task: Task, size: int, threads: int = 0) -> tuple[MovingTargetEnv, TapedBatch]:
    """``size`` environments of ``task``, and the tape of their simulation; raises `InputError` as `bench` says."""
    env = task.make_env(task.default_settings(), num_envs=size, seed=0, split=SPLIT, num_threads=threads)
    # Any environment may be a task's, and only those over a MuJoCo batch can be taped.
    simulation: Any = getattr(env, "simulation", None)
    batch = getattr(simulation, "batch", None)
    if not isinstance(batch, Batch):
        found = type(env).__name__
        raise InputError(f"the environment must have a mujoco.batch.Batch at simulation.batch, but {found} has none")
    simulation.batch = taped = TapedBatch(batch)
    return env, taped


def _planners(task: Task, planners: Mapping[str, Planner] | Sequence[str] | None) -> dict[str, Planner]:
    if isinstance(planners, Mapping):
        return dict(planners)
    usual = [name for name in PLANNERS if name in task.planners] or task.default_planners
    rows, static_rows = task.rows_at_once
    names = usual if planners is None else planners
    return {name: task.planner(name, chunk=rows, static_chunk=static_rows) for name in names}


def _random(env: MovingTargetEnv) -> Iterator[None]:
    """The environment alone, under random actions."""
    size = env.action_spec.shape[-1]
    random = torch.Generator().manual_seed(0)
    actions = torch.rand(RANDOM_ACTIONS, env.num_envs, size, generator=random) * 2.0 - 1.0
    tensordict: TensorDictBase = env.reset()
    while True:
        for action in actions:
            _, tensordict = env.step_and_maybe_reset(tensordict.set(keys.ACTION, action))
            yield


def _take_turns(
    loop: Iterator[object], taped: TapedBatch, steps: int, progress: Callable[[int], object]
) -> tuple[list[float], list[float], float]:
    """Durations of each step [s] of MuJoCo alone and of ``loop``, and the greatest difference of their positions."""
    alone, qpos = RawSimulation(taped), torch.from_numpy(taped.batch.bind("qpos"))
    raw: list[float] = []
    taken: list[float] = []
    error = 0.0
    while len(taken) < steps:
        entries = []
        for _ in range(min(BLOCK, steps - len(taken))):
            before = taped.seconds
            whole = duration(partial(next, loop))
            taken.append(whole - (taped.seconds - before))
            entries.append(taped.take())
        raw += [duration(partial(alone.play, calls)) for calls in entries]
        error = max(error, float((alone.qpos - qpos).abs().max()))
        progress(len(entries))
    return raw, taken, error


def _rows(what: str, env: MovingTargetEnv, raw: Sequence[float], taken: Sequence[float], error: float) -> list[Row]:
    simulation: Any = getattr(env, "simulation")  # noqa: B009
    rows = []
    name = type(env).__name__ if what == RANDOM else "evaluation loop"
    for implementation, durations in (("mujoco.batch", raw), (name, taken)):
        about = {
            "what": what,
            "implementation": implementation,
            "batch": env.num_envs,
            "threads": simulation.batch.nthread or usable_cores(),
            "compiled": False,
            "device": "cpu",
        }
        rates = {
            "env_steps_per_second": round(env.num_envs * len(durations) / sum(durations)),
            "share_of_raw": round(sum(raw) / sum(durations), 3),
        }
        rows.append(about | figures(durations, env.num_envs) | {"max_error": error} | rates)
    return rows
