"""Batches of which some rows hold what is no number, or no measurement: fuzzed, for every kind of planner."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from random import Random
from typing import Any

import torch

from benchmarks.torture.promise import Cases, Promise, attempt
from torchdyn_plan import keys
from torchdyn_plan.planners import DynamicPlanner, PlanStatus
from torchdyn_plan.tasks import load_task

ROWS = 5
VALUES = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e20, -1e9, 2e6)
PLANNERS = (
    ("trapper", "corner", "ik"),
    ("trapper", "corner", "rl"),
    ("trapper", "wait_and_drop", "ik"),
    ("trapper", "wait_and_drop", "rl"),
    ("trapper", "exact", "ik"),
    ("trapper", "wait", "rl"),
    ("trapper", "pursuit", "ik"),
    ("trapper", "pursuit", "rl"),
    ("fetch_reach", "corner", "proportional"),
    ("fetch_reach", "exact", "rl"),
    ("fetch_reach", "pursuit", "rl"),
)
"""Task, planner and static planner."""
MOMENTS = (0, 5, 13, 14, 30, 49)
"""Control steps at which planners are looked at: of their first plan, of later ones, and between."""


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Batches, as many of each planner."""
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        for about in PLANNERS:
            task, name, static = about
            planner = load_task(task).planner(name, static, chunk=ROWS, static_chunk=ROWS).requires_grad_(False)
            for _ in range(-(-count // (len(PLANNERS) * len(MOMENTS)))):
                for moment, usual in _moments(task, planner):
                    fault = _try(draw, planner, moment, usual)
                    yield None if fault is None else f"{', '.join(about)}: {fault}"


_seen: dict[int, list[tuple[Any, Any]]] = {}


def _moments(task: str, planner: Any) -> list[tuple[Any, Any]]:
    """What ``planner`` sees at each of `MOMENTS`, and what it makes of it when nothing is wrong."""
    if id(planner) not in _seen:
        made = load_task(task)
        env = made.make_env(made.default_settings(), num_envs=ROWS, seed=0, split="dev", num_threads=1)
        td, found = env.reset(), []
        for step in range(max(MOMENTS) + 1):
            if step in MOMENTS:
                found.append((td.clone(), planner(td.clone())))
            td = env.step_and_maybe_reset(planner(td))[1]
        _seen.clear()
        _seen[id(planner)] = found
    return _seen[id(planner)]


def _try(draw: Random, planner: Any, moment: Any, usual: Any) -> str | None:
    seen = moment.clone()
    floating = [key for key in planner.in_keys if _is_floating(seen, key)]
    bad = sorted(draw.sample(range(ROWS), draw.randrange(1, ROWS)))
    spoiled: dict[int, set[Any]] = {}
    for row in bad:
        for key in draw.sample(floating, draw.choice((1, 1, 2))):
            _spoil(draw, seen[key][row])
            spoiled.setdefault(row, set()).add(key)
    outcome = attempt(planner, seen)
    where = {row: [str(key) for key in some] for row, some in spoiled.items()}
    if outcome.value is None:
        return f"{outcome.foreign or outcome.refused} with {where}"
    fault = _judge(planner, outcome.value, usual, spoiled)
    return None if fault is None else f"{fault} with {where}"


def _is_floating(seen: Any, key: Any) -> bool:
    value = seen.get(key, None)
    return isinstance(value, torch.Tensor) and value.is_floating_point() and value.numel() > 0


def _spoil(draw: Random, value: torch.Tensor) -> None:
    """Write something bad into all or one entry of ``value``."""
    flat, bad = value.view(-1), draw.choice(VALUES)
    if draw.random() < 0.5:
        flat.fill_(bad)
    else:
        flat[draw.randrange(len(flat))] = bad


def _judge(planner: Any, found: Any, usual: Any, spoiled: dict[int, set[Any]]) -> str | None:
    """What is wrong with what a planner made of a batch with bad rows."""
    good = [row for row in range(ROWS) if row not in spoiled]
    for key in ("action", "goal", "arrival_steps"):
        if found.get(key, None) is not None and usual.get(key, None) is not None:
            if not torch.isfinite(found[key]).all():
                return f"{key} is no number"
            if not torch.equal(found[key][good], usual[key][good]):
                return f"{key} of a good row is another"
    if (found["action"].abs() > 1.0 + 1e-6).any():
        return "an action is beyond 1"
    for row, some in spoiled.items():
        if any(isinstance(key, str) and key in (keys.ROBOT_STATE, keys.TOOL_POS, keys.JOINT_POS) for key in some):
            if found["action"][row].any():
                return "a row that is not seen moves"
            if isinstance(planner, DynamicPlanner) and found["plan", "status"][row] != PlanStatus.BAD_INPUT:
                return "a row that is not seen has no BAD_INPUT"
    return None


PROMISE = Promise(
    says="a bad row never stops or changes the others, and never moves blindly",
    cases=cases,
    count=6000,
)
