"""Actions that are no number, in some of the environments that run side by side."""

from __future__ import annotations

import math
from pathlib import Path
from random import Random
from typing import Any

import torch

from benchmarks.torture.promise import Cases, Promise, attempt
from torchdyn_plan.tasks import load_task

ROWS = 6
TASKS = ("trapper", "fetch_reach")
LEFT_OUT = ("next", "action")


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Steps of twins, of which one is given bad actions where the other holds still: half of them of each task."""
    for task in TASKS:
        one, other, strict = (_env(task, how) for how in ("hold", "hold", "raise"))
        states = [one.reset(), other.reset()]
        torch.manual_seed(draw.randrange(2**31))
        strict.reset()
        for _ in range(-(-count // len(TASKS))):
            action = 2.0 * torch.rand(ROWS, one.action_spec.shape[-1]) - 1.0
            bad = draw.sample(range(ROWS), draw.randrange(0, ROWS + 1))
            still, spoiled = action.clone(), action.clone()
            for row in bad:
                still[row] = 0.0
                places = draw.sample(range(action.shape[-1]), draw.randrange(1, action.shape[-1]))
                spoiled[row, places] = draw.choice((math.nan, math.inf, -math.inf))
            fault = _refuses(strict, states[1], spoiled) if bad and draw.random() < 0.1 else None
            for env, state, given in ((one, 0, spoiled), (other, 1, still)):
                states[state] = env.step_and_maybe_reset(states[state].set("action", given))[1]
            yield fault or _differing(task, *states)


def _env(task: str, on_bad_action: str) -> Any:
    made = load_task(task)
    how = {"num_envs": ROWS, "seed": 0, "split": "dev", "num_threads": 1}
    env = made.make_env(made.default_settings(), **how)
    env.on_bad_action = on_bad_action
    return env


def _refuses(env: Any, state: Any, action: torch.Tensor) -> str | None:
    outcome = attempt(env.step_and_maybe_reset, state.copy().set("action", action))
    if outcome.refused is None:
        return f"a bad action was taken, or refused by {outcome.foreign}"
    return None


def _differing(task: str, one: Any, other: Any) -> str | None:
    for key, value in one.exclude(*LEFT_OUT).items():
        if not torch.equal(value, other[key]):
            return f"{task}: {key} differs from that of an environment that held still"
    return None


PROMISE = Promise(
    says="an action that is no number holds its own row still, or is an error, as was chosen; others do not notice",
    cases=cases,
    count=2000,
)
