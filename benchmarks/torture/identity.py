"""Results of two kinds in one folder."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from random import Random
from typing import Any

from benchmarks.torture import forked
from benchmarks.torture.commands_in_small import start
from benchmarks.torture.promise import Cases, Promise, attempt
from torchdyn_plan.evaluation.identity import FREE, check_evaluation_folder, check_sweep_folder, identity_of
from torchdyn_plan.files import write_json

CONFIG: dict[str, Any] = {
    "task": "trapper",
    "planners": ["corner", "pursuit"],
    "static": "ik",
    "episodes": 4,
    "split": "test",
    "num_envs": 2,
    "num_threads": 1,
    "delivery": None,
    "scene": "abc",
    "weights": {"corner": "0123", "pursuit": None},
    "settings": {"velocity": 3.0, "friction": 0.0},
    "seed": 0,
}
"""What was run, as results tell it."""
WHOLE = 60
"""Of so many cases one is of two commands that write into one folder."""
COMMAND = ("evaluate", "--planners", "pursuit", "--episodes", "1", "--num-envs", "1", "--velocity", "1")
OTHERS = {
    "--episodes": ("2", True),
    "--velocity": ("2", True),
    "--friction": ("1", True),
    "--seed": ("1", True),
    "--split": ("dev", True),
    "--planners": ("wait", True),
    "--static": ("rl", True),
    "--num-envs": ("2", False),
    "--threads": ("2", False),
}
"""Another value of an option, and whether it decides the result."""


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Pairs of results: most by what they say of themselves, some by whole commands."""
    for number in range(count - count // WHOLE):
        yield _pair(draw, folder / str(number % 20))
    for number in range(count // WHOLE):
        yield _commands(draw, folder / f"commands-{number}")


def _pair(draw: Random, folder: Path) -> str | None:
    """One result in a folder, and another that asks to be written there."""
    there, here = copy.deepcopy(CONFIG), copy.deepcopy(CONFIG)
    for _ in range(draw.choice((0, 1, 1, 2))):
        name = draw.choice(list(here))
        here[name] = _other(draw, here[name])
    version = draw.choice((None, None, None, "9.9.9"))
    other = {k: v for k, v in here.items() if k not in FREE} != {k: v for k, v in there.items() if k not in FREE}
    shutil.rmtree(folder, ignore_errors=True)
    if draw.random() < 0.5:
        versions = {"torchdyn-plan": version or identity_of(there)["version"]}
        write_json(folder / "results.json", {"config": there, "versions": versions})
        check = attempt(check_evaluation_folder, folder, here)
    else:
        write_json(folder / "sweep.json", identity_of(there, version))
        check = attempt(check_sweep_folder, folder, identity_of(here))
    if check.foreign:
        return check.foreign
    if (check.refused is not None) != (other or version is not None):
        return f"{'refused' if check.refused else 'taken'}: {json.dumps(here)} beside {json.dumps(there)}"
    return None


def _other(draw: Random, value: Any) -> Any:
    if isinstance(value, dict):
        name = draw.choice(list(value))
        return value | {name: _other(draw, value[name])}
    if isinstance(value, list):
        return draw.choice((value[:1], value[::-1], [*value, "exact"]))
    if isinstance(value, (int, float)):
        return value + 1
    return f"{value}x"


def _commands(draw: Random, out: Path) -> str | None:
    """A command, then another into the same folder: refused where the result would be another, its files as before."""
    option = draw.choice(list(OTHERS))
    value, decides = OTHERS[option]
    first = forked.run(lambda: start([*COMMAND, "--out", str(out)]))
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    second = forked.run(lambda: start([*COMMAND, option, value, "--out", str(out)]))
    fault = forked.complaint(first, (0,)) or forked.complaint(second, (2,) if decides else (0,))
    if fault is None and decides and {file.name: file.read_bytes() for file in out.iterdir()} != before:
        fault = "a refused command changed the results"
    return None if fault is None else f"{option} {value}: {fault}"


PROMISE = Promise(
    says="a folder never holds results of two kinds: task, settings, scene, weights, planners and version decide",
    cases=cases,
    count=2000,
)
