"""Folders of training data that were mixed, cut short, renamed, or edited by hand."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import torch
from torch import Tensor

from benchmarks.torture.damage import damaged_bytes, damaged_json, json_bytes
from benchmarks.torture.promise import Cases, Promise, attempt
from torchdyn_plan.errors import InputError
from torchdyn_plan.tasks import Task, load_task
from torchdyn_plan.training import lay_end_to_end, shards
from torchdyn_plan.training.collect import ENTRIES, collect
from torchdyn_plan.training.shards import read_description, read_shards, shard_path

SIZES = {"paths": 4, "arrivals": 8}
"""Episodes in a shard."""
SCENE = "here"


class _Killed(BaseException):
    """Stands for a SIGKILL between two shards."""


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Folders, each of some collections and some mischief, that a training reads."""
    former = dict(shards.SHARD)
    shards.SHARD.update(SIZES)
    try:
        for number in range(count):
            place = folder / str(number)
            stem = draw.choice(list(SIZES))
            for _ in range(draw.choice((1, 1, 2, 3))):
                _collect(draw, place, stem)
            for _ in range(draw.choice((0, 1, 1, 2))):
                _spoil(draw, place, stem)
            yield _judge(place, stem)
            shutil.rmtree(place, ignore_errors=True)
    finally:
        shards.SHARD.update(former)


def _collect(draw: Random, place: Path, stem: str) -> None:
    """A collection that ends, is killed, or is refused."""
    asked = {
        "episodes": draw.randrange(1, 14 if stem == "paths" else 30),
        "seed": draw.choice((0, 0, 1)),
        "num_envs": draw.choice((2, 2, 2, 3)),
    }
    static = draw.choice(("ik", "ik", "ik", "rl"))
    task = _task(draw.choice((SCENE, SCENE, SCENE, "elsewhere")), draw.choice((None, None, 0, 1)))
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            collect(task, stem, place, num_threads=1, static=static if stem == "arrivals" else None, **asked)
    except (_Killed, InputError):
        pass


def _task(scene: str, killed_at: int | None) -> Task:
    """A task whose data tell, number by number, what they are of; its collections are killed at a shard."""
    made = 0

    def dies() -> None:
        nonlocal made
        if made == killed_at:
            raise _Killed
        made += 1

    def record_paths(blocks: Sequence[Tensor], *, seed: int, num_threads: int) -> dict[str, Tensor]:
        dies()
        return _paths(torch.cat(list(blocks)), seed, scene)

    def record_arrivals(planner: Any, *, num_envs: int, sequences: int, seed: int, num_threads: int) -> Any:
        dies()
        return _arrivals(num_envs * sequences, seed, scene, planner)

    statics = {name: lambda chunk=None, weights=None, name=name: name for name in ("ik", "rl")}
    return dataclasses.replace(
        load_task("trapper"),
        digest=lambda: scene,
        static_planners=statics,
        record_paths=record_paths,
        record_arrivals=record_arrivals,
    )


def _paths(episodes: Tensor, seed: int, scene: str) -> dict[str, Tensor]:
    path = (100.0 * seed + episodes + (50.0 if scene != SCENE else 0.0)).view(-1, 1, 1).expand(-1, 3, 3).clone()
    return lay_end_to_end(path, path[:, 0, 0])


def _arrivals(count: int, seed: int, scene: str, planner: Any) -> dict[str, Tensor]:
    state = torch.full(
        (count, 3), float(seed % 1000) + (0.5 if scene != SCENE else 0.0) + (0.25 if planner == "rl" else 0.0)
    )
    return {"robot_state": state, "goal": state, "arrival": torch.ones(count), "run": torch.arange(count)}


def _spoil(draw: Random, place: Path, stem: str) -> None:
    """Some mischief, if there is anything to do it with."""
    made = sorted(place.glob(f"{stem}-*.safetensors"))
    told = sorted(place.glob(f"{stem}-*.json"))
    if not made or not told:
        return
    one, other, text = draw.choice(made), draw.choice(made), draw.choice(told)
    acts: list[Callable[[], object]] = [
        one.unlink,
        text.unlink,
        lambda: shard_path(place, stem, draw.randrange(3), draw.randrange(5)).write_bytes(one.read_bytes()),
        lambda: one.rename(shard_path(place, stem, draw.randrange(3), draw.randrange(5))),
        lambda: other.write_bytes(one.read_bytes()),
        lambda: one.write_bytes(damaged_bytes(draw, one.read_bytes())),
        lambda: text.write_bytes(damaged_bytes(draw, text.read_bytes())),
        lambda: _edit(draw, text, anyhow=True),
        lambda: _edit(draw, text),
        lambda: (place / f"{stem}-{draw.randrange(3)}.json").write_bytes(text.read_bytes()),
    ]
    draw.choice(acts)()


def _edit(draw: Random, text: Path, *, anyhow: bool = False) -> None:
    """Change a description: one of its arguments, or ``anyhow``."""
    try:
        content = json.loads(text.read_bytes())
        arguments = content["arguments"]
    except (ValueError, LookupError, TypeError):
        # It was damaged before.
        return
    if anyhow:
        text.write_bytes(json_bytes(damaged_json(draw, content)))
        return
    name = draw.choice(("episodes", "seed", "num_envs", "static"))
    arguments[name] = draw.choice(("ik", "rl")) if name == "static" else draw.randrange(15)
    text.write_text(json.dumps(content))


def _judge(place: Path, stem: str) -> str | None:
    """Whether what is read is what the descriptions say, to the last number."""
    about = attempt(read_description, place, stem, scene=SCENE)
    if about.value is None:
        return None if about.foreign is None else f"description: {about.foreign}"
    read = attempt(read_shards, place, stem, ENTRIES[stem])
    if read.value is None:
        return None if read.foreign is None else f"shards: {read.foreign}"
    wanted = [shard for asked in about.value["data"] for shard in _expected(stem, asked)]
    if len(wanted) != len(read.value):
        return f"{len(read.value)} shards were read, {len(wanted)} described"
    # Shards are read in the order of their names, as descriptions are.
    for shard, other in zip(read.value, wanted, strict=True):
        for name, value in other.items():
            if not torch.equal(shard[name], value):
                return f"{stem}: {name} is not what its description says"
    return None


def _expected(stem: str, asked: dict[str, Any]) -> list[dict[str, Tensor]]:
    """The shards of a collection that was asked for ``asked``."""
    from torchdyn_plan.training.collect import SERIES

    found, first = [], 0
    for index, episodes in enumerate(shards.shard_sizes(stem, asked["episodes"])):
        if stem == "paths":
            found.append(_paths(torch.arange(first, first + episodes), asked["seed"], SCENE))
        else:
            blocks = -(-episodes // asked["num_envs"])
            seed = asked["seed"] * SERIES + index
            found.append(_arrivals(blocks * asked["num_envs"], seed, SCENE, asked["static"]))
        first += episodes
    return found


PROMISE = Promise(
    says="a training reads what the descriptions of its data say, to the last number, or refuses by name",
    cases=cases,
    count=2000,
)
