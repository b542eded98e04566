"""Damaged files of state: checkpoints, episodes, sweeps and results."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import torch

from benchmarks.torture import forked
from benchmarks.torture.commands_in_small import differing, ends, start
from benchmarks.torture.damage import damaged_bytes, damaged_json, json_bytes, with_header
from benchmarks.torture.promise import Cases, Outcome, Promise, attempt
from torchdyn_plan.evaluation.identity import check_evaluation_folder, check_sweep_folder
from torchdyn_plan.evaluation.results import EpisodeOutcomes
from torchdyn_plan.files import read_json
from torchdyn_plan.tasks import load_task
from torchdyn_plan.training.checkpoint import read_checkpoint, write_checkpoint
from torchdyn_plan.training.optimise import Progress

SIZES = ("--episodes", "2", "--repeats", "1", "--threads", "1")
WORDS = ("sweep", "--over", "velocity", "--values", "1", "3", "--planners", "pursuit", *SIZES, "--out")
"""Of the sweep."""
WHOLE = 40
"""Of so many cases one is a whole sweep that goes on from a damaged folder."""


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Damaged files, one in `WHOLE` of them in a folder in which a sweep goes on."""
    yield from _checkpoints(draw, folder / "checkpoint.safetensors", count // 3)
    swept = folder / "swept"
    ended = forked.run(lambda: start([*WORDS, str(swept)]))
    if ended.code:
        yield f"the sweep to be damaged failed: {ended.told[-200:]}"
        return
    yield from _readers(draw, swept, count * 2 // 3)
    yield from _sweeps(draw, swept, folder / "again", count // WHOLE)


def _checkpoints(draw: Random, file: Path, count: int) -> Cases:
    tensors = {"network.weight": torch.arange(12.0), "generator": torch.arange(8, dtype=torch.uint8)}
    settings = {"lr": 0.1, "seed": 3, "network": {"hidden": 8}}
    progress = {"step": 4, "total": 0.5, "counted": 2, "curve": [{"step": 2, "loss": 0.25}]}
    write_checkpoint(file, tensors, settings=settings, progress=progress)
    whole = file.read_bytes()
    for _ in range(count):
        file.write_bytes(_damaged(draw, whole))
        outcome = attempt(read_checkpoint, file, settings=settings, schema=Progress)
        fault = outcome.foreign
        if outcome.value is not None:
            found, told = outcome.value
            same = found.keys() == tensors.keys() and all(torch.equal(found[name], tensors[name]) for name in tensors)
            fault = None if same and told == progress else "another state was believed"
        yield None if fault is None else f"checkpoint: {fault}"


def _damaged(draw: Random, whole: bytes) -> bytes:
    if draw.random() < 0.4:
        return damaged_bytes(draw, whole)

    def other(header: dict[str, Any]) -> Any:
        if draw.random() < 0.3:
            return damaged_json(draw, header)
        about, name = dict(header["__metadata__"]), draw.choice(("settings", "progress"))
        about[name] = json_bytes(damaged_json(draw, json.loads(about[name]))).decode()
        return header | {"__metadata__": about}

    return with_header(whole, other)


def _readers(draw: Random, swept: Path, count: int) -> Cases:
    """Everything that reads JSON back, one after the other."""
    task = load_task("trapper")
    point = next((swept / "points").iterdir())
    outcomes = json.loads(point.read_text())["planners"]["pursuit"]
    results, identity = (json.loads((swept / name).read_text()) for name in ("results.json", "sweep.json"))
    readers: list[tuple[str, Any, Callable[[Path], Any]]] = [
        ("episodes.json", outcomes, lambda file: EpisodeOutcomes.from_json(read_json(file), task)),
        ("results.json", results, lambda file: check_evaluation_folder(file.parent, results["config"])),
        ("sweep.json", identity, lambda file: check_sweep_folder(file.parent, identity)),
    ]
    for number in range(count):
        name, content, read = readers[number % len(readers)]
        file = swept.parent / "read" / str(number % len(readers)) / name
        file.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(content).encode()
        file.write_bytes(damaged_bytes(draw, text) if draw.random() < 0.3 else json_bytes(damaged_json(draw, content)))
        outcome = attempt(read, file)
        fault = outcome.foreign or (_believed(outcome) if name == "episodes.json" else None)
        yield None if fault is None else f"{name}: {fault} ({file.read_bytes()[:300]!r})"


def _believed(outcome: Outcome) -> str | None:
    """What is wrong with episodes that were read from a damaged file."""
    if outcome.value is None:
        return None
    found: EpisodeOutcomes = outcome.value
    for name, value in {"steps": found.steps, **found.evidence}.items():
        if value.is_floating_point() and not torch.isfinite(value).all():
            return f"{name} holds what is no number, and was believed"
    return None


def _sweeps(draw: Random, swept: Path, again: Path, count: int) -> Cases:
    """A sweep goes on in a folder of which one file is damaged: refused, or the same in the end."""
    content = {file.relative_to(swept): file.read_bytes() for file in swept.rglob("*.json")}
    for number in range(count):
        out = again / str(number)
        hit = draw.choice(sorted(content))
        for name, text in content.items():
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (out / name).write_bytes(text)
        if draw.random() < 0.3:
            spoiled = damaged_bytes(draw, content[hit])
        else:
            spoiled = json_bytes(damaged_json(draw, json.loads(content[hit])))
        (out / hit).write_bytes(spoiled)
        ended = forked.run(lambda out=out: start([*WORDS, str(out)]))
        fault = forked.complaint(ended)
        if fault is None and ended.code == 0:
            other = differing(ends(swept), ends(out))
            fault = f"it ended otherwise: {', '.join(other)}" if other else None
        yield None if fault is None else f"sweep with {hit} damaged: {fault} ({spoiled[:200]!r})"


PROMISE = Promise(
    says="a damaged file of state is refused by name, or what it says is the same",
    cases=cases,
    count=4000,
)
