"""Damaged files of networks and of planners."""

from __future__ import annotations

import copy
import json
import resource
from pathlib import Path
from random import Random
from typing import Any

import torch

from benchmarks.torture.damage import STRANGE, damaged_bytes, damaged_json, json_bytes, with_header
from benchmarks.torture.promise import Cases, Promise, attempt
from torchdyn_plan.nets import Actor, ETAConfig, ETANetwork, Forecaster, ForecasterConfig, PolicyConfig
from torchdyn_plan.planners import DynamicPlanner
from torchdyn_plan.tasks import load_task

MOST = 512 * 2**20
"""No damaged file of a small network may make the process grow by more [bytes]."""


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Damaged files: three quarters of networks, the rest of planners."""
    networks: dict[str, Any] = {
        "forecaster": Forecaster(ForecasterConfig(history=4, horizon=10, channels=4, convolutions=1, hidden=8, rank=4)),
        "eta": ETANetwork(ETAConfig(robot_state_size=15, bins=12, hidden=8)),
        "policy": Actor(PolicyConfig(robot_state_size=15, action_size=6, hidden=8, layers=1)),
    }
    for name, network in networks.items():
        file = network.save_pretrained(folder / name)
        whole = file.read_bytes()
        for _ in range(count // 4):
            yield _network(draw, type(network), file, whole, name)
    load_task("trapper").planner("wait_and_drop", "ik").save_pretrained(folder / "planner")
    text = (folder / "planner" / "planner.json").read_bytes()
    for _ in range(count // 4):
        yield _planner(draw, folder / "planner", text)


def _network(draw: Random, kind: Any, file: Path, whole: bytes, name: str) -> str | None:
    file.write_bytes(_damaged(draw, whole))
    before = _memory()
    outcome = attempt(kind.from_pretrained, file)
    grown = _memory() - before
    if outcome.foreign is not None:
        return f"{name}: {outcome.foreign}"
    if grown > MOST:
        return f"{name}: {grown >> 20} MiB were taken"
    if outcome.value is not None:
        bad = [key for key, value in outcome.value.state_dict().items() if not torch.isfinite(value).all()]
        return f"{name}: believed with {bad[0]} no number" if bad else None
    return None


def _damaged(draw: Random, whole: bytes) -> bytes:
    """Damaged anywhere, in the header, or in the configuration in it."""
    kind = draw.randrange(3)
    if kind == 0:
        return damaged_bytes(draw, whole)
    if kind == 1:
        return with_header(whole, lambda header: damaged_json(draw, header))

    def other(header: dict[str, Any]) -> dict[str, Any]:
        config = json.loads(header["__metadata__"]["config"])
        place = draw.choice(list(config))
        if draw.random() < 0.5:
            config[place] = copy.deepcopy(draw.choice((10**9, 10**12, 2**62, *STRANGE)))
        if draw.random() < 0.7:
            config = damaged_json(draw, config)
        text = json_bytes(config).decode()
        return header | {"__metadata__": header["__metadata__"] | {"config": text}}

    return with_header(whole, other)


def _planner(draw: Random, folder: Path, text: bytes) -> str | None:
    anyhow = draw.random() < 0.3
    content = damaged_bytes(draw, text) if anyhow else json_bytes(damaged_json(draw, json.loads(text)))
    (folder / "planner.json").write_bytes(content)
    outcome = attempt(DynamicPlanner.from_pretrained, folder)
    return None if outcome.foreign is None else f"planner: {outcome.foreign}"


def _memory() -> int:
    """Most memory that the process has had so far [bytes]."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


PROMISE = Promise(
    says="a damaged file of a network or a planner is refused by the project's own error, before memory is taken",
    cases=cases,
    count=4000,
)
