"""Environments that were built before a fork, and episodes however many run side by side."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

import torch

from benchmarks.torture import forked
from benchmarks.torture.promise import Cases, Promise
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.episodes import find_truth, run_episodes
from torchdyn_plan.tasks import load_task

EPISODES = 6
TASKS = (("trapper", "pursuit"), ("fetch_reach", "pursuit"))


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Half of them forks, half of them evaluations of the same episodes; each in a process of its own.

    This process starts no thread: it is the one that all others are forked from.
    """
    for number in range(count // 2):
        task, rows = TASKS[number % 2][0], draw.choice((1, 3))
        ended = forked.run(lambda task=task, rows=rows: _fork(task, rows), at_most=60.0)
        yield None if ended.code == 0 else f"{task} after a fork: exit {ended.code}, {ended.told[-200:]}"
    for about in TASKS:
        forked.run(lambda about=about: torch.save(_outcomes(*about, EPISODES, 1), folder / about[0]))
    for number in range(count - count // 2):
        about = TASKS[number % 2]
        how = draw.randrange(1, 9), draw.choice((1, 2, 0))
        ended = forked.run(lambda about=about, how=how: _compare(folder / about[0], _outcomes(*about, *how)))
        yield None if ended.code == 0 else f"{about}, {how} side by side and threads: {ended.told[-200:] or 'others'}"


def _compare(file: Path, found: list[torch.Tensor]) -> None:
    """End well if the episodes are those in ``file``."""
    usual = torch.load(file, weights_only=True)
    if not all(torch.equal(one, other) for one, other in zip(usual, found, strict=True)):
        raise SystemExit(3)


def _fork(task: str, rows: int) -> None:
    """Build an environment, fork, and use it there in two ways; end well if both are refused."""
    made = load_task(task)
    env = made.make_env(made.default_settings(), num_envs=rows, seed=0, split="dev", num_threads=2)
    state = env.rand_action(env.reset())
    for use in (env.reset, lambda: env.step_and_maybe_reset(state)):
        ended = forked.run(lambda use=use: _refused(use), at_most=20.0)
        if ended.code:
            raise SystemExit(f"exit {ended.code}: {ended.told[-200:]}")


def _refused(use: Any) -> None:
    """End well if the project's own error says what is wrong."""
    try:
        use()
    except InputError as error:
        if "process" in str(error):
            return
    raise SystemExit(3)


def _outcomes(task: str, planner: str, side_by_side: int, threads: int) -> list[torch.Tensor]:
    made = load_task(task)
    settings = made.default_settings()
    truth = find_truth(made, settings, episodes=EPISODES, seed=0, split="dev", num_threads=threads)
    how = {"episodes": EPISODES, "split": "dev", "num_envs": side_by_side, "num_threads": threads, "progress": False}
    chunk, static_chunk = made.rows_at_once
    player = made.planner(planner, made.default_static, chunk=chunk, static_chunk=static_chunk)
    found = run_episodes(player, made, settings, truth, **how)
    return [found.success, found.steps, found.cause]


PROMISE = Promise(
    says="an environment from before a fork says so; episodes are the same however many run side by side",
    cases=cases,
    count=60,
)
