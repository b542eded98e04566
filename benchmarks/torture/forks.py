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
    """Half of them forks, half of them evaluations of the same episodes."""
    for number in range(count // 2):
        task = TASKS[number % 2][0]
        made = load_task(task)
        env = made.make_env(made.default_settings(), num_envs=draw.choice((1, 3)), seed=0, split="dev", num_threads=2)
        state = env.rand_action(env.reset())
        use = draw.choice((env.reset, lambda env=env, state=state: env.step_and_maybe_reset(state)))
        ended = forked.run(lambda use=use: _refused(use), at_most=20.0)
        yield None if ended.code == 0 else f"{task} after a fork: exit {ended.code}, {ended.told[-200:]}"
    usual = {about: _outcomes(*about, EPISODES, 1) for about in TASKS}
    for number in range(count - count // 2):
        about = TASKS[number % 2]
        side_by_side, threads = draw.randrange(1, 9), draw.choice((1, 2, 0))
        found = _outcomes(*about, side_by_side, threads)
        same = all(torch.equal(one, other) for one, other in zip(usual[about], found, strict=True))
        yield None if same else f"{about}: other episodes with {side_by_side} side by side on {threads} threads"


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
    count=80,
)
