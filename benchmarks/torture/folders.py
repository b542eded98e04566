"""Places where nothing can be written or read: each is the project's own error, and leaves nothing behind."""

from __future__ import annotations

import errno
import functools
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any
from unittest import mock

import torch

from benchmarks.torture.promise import Cases, Promise, attempt
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.identity import check_sweep_folder
from torchdyn_plan.files import check_writable_folder, read_json, read_tensors, write_json, write_tensors, write_whole
from torchdyn_plan.nets import Actor, PolicyConfig
from torchdyn_plan.tasks import load_task
from torchdyn_plan.training.shards import read_description

CODES = (errno.ENOSPC, errno.EACCES, errno.EIO, errno.EROFS, errno.EDQUOT, errno.ENAMETOOLONG, errno.ESTALE)
STEPS = ((tempfile, "mkdtemp"), (os, "fsync"), (Path, "replace"), (Path, "chmod"), (Path, "mkdir"), (Path, "open"))
"""What writing a file goes through."""


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Half of them places that are none, half of them failures at a step of writing."""
    for number in range(count // 2):
        place = folder / str(number)
        place.mkdir()
        where = _places(draw, place)
        what, call = draw.choice(_uses())
        before = _tree(place)
        outcome = attempt(call, where)
        fault = outcome.foreign
        if fault is None and outcome.refused is None and "reads" in what:
            fault = "it read what is not there"
        if fault is None and outcome.refused is not None and _tree(place) != before:
            fault = f"it left {sorted(_tree(place) - before)[0]}"
        yield None if fault is None else f"{what} {str(where)[-60:]!r}: {fault}"
    for number in range(count // 2):
        place = folder / f"fails-{number}"
        place.mkdir()
        yield _fails(draw, place)


def _places(draw: Random, place: Path) -> Path:
    """A path that is hard to write to."""
    (place / "file").write_text("{}")
    (place / "dangling").symlink_to(place / "nowhere" / "x")
    (place / "loop").symlink_to(place / "loop")
    (place / "a.json").mkdir()
    (place / "a.json" / "within").write_text("x")
    return draw.choice(
        (
            place / "file" / "b.json",
            place / "file" / "deeper" / "b.json",
            place / ("x" * 300),
            place / ("y" * 300) / "a.json",
            place / "z\0z",
            place / "dangling" / "c.json",
            place / "loop" / "c.json",
            place / "loop",
            place / "a.json",
            Path("/proc/1/nothing/a.json"),
            Path("/dev/null/a.json"),
            place / "/".join(["d" * 200] * 30) / "a.json",
            place / "\udcff",
        )
    )


@functools.cache
def _uses() -> list[tuple[str, Callable[[Path], Any]]]:
    """What is done with a place."""
    network = Actor(PolicyConfig(robot_state_size=3, tool_slice=(0, 3), action_size=3, hidden=4, layers=1))
    return [
        ("writes JSON to", lambda path: write_json(path, {"a": 1})),
        ("writes tensors to", lambda path: write_tensors(path, {"a": torch.ones(3)})),
        ("writes text to", lambda path: write_whole(path, lambda file: file.write_text("x"))),
        ("probes", check_writable_folder),
        ("saves a network in", network.save_pretrained),
        ("saves a planner in", load_task("trapper").planner("corner", "ik").save_pretrained),
        ("reads JSON of", lambda path: read_json(path / "none")),
        ("reads tensors of", lambda path: read_tensors(path / "none", InputError)),
        ("reads a network of", lambda path: Actor.from_pretrained(path / "none")),
        ("reads data of", lambda path: read_description(path / "none", "paths", scene="x")),
        ("looks for a sweep in", lambda path: check_sweep_folder(path, {})),
    ]


def _tree(place: Path) -> set[str]:
    return {str(path) for path in place.rglob("*")}


def _fails(draw: Random, place: Path) -> str | None:
    code, (owner, name) = draw.choice(CODES), draw.choice(STEPS)
    what, call = draw.choice(_uses()[:6])
    target = place / "there.json"
    write_json(target, {"saved": 1})
    before, saved = _tree(place), target.read_bytes()

    def fail(*_: Any, **__: Any) -> None:
        raise OSError(code, os.strerror(code))

    with mock.patch.object(owner, name, fail):
        outcome = attempt(call, place if what in ("probes", "saves a planner in") else target)
    fault = outcome.foreign
    if fault is None and (target.read_bytes() != saved) and outcome.refused is not None:
        fault = "what was there is lost"
    if fault is None and outcome.refused is not None and _tree(place) != before:
        fault = f"it left {sorted(_tree(place) - before)}"
    return None if fault is None else f"{what} where {name} fails with {os.strerror(code)}: {fault}"


PROMISE = Promise(
    says="a folder that fails, at any step, is the project's own error, and what was there stays",
    cases=cases,
    count=1200,
)
