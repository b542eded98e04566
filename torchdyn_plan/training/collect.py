"""Training data by simulation: paths of the rolling ball, and arrivals of a static planner."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from torchdyn_plan.cli_arguments import CollectArguments
from torchdyn_plan.envs.episodes import draw_starts
from torchdyn_plan.envs.fetch import fetch_digest
from torchdyn_plan.envs.reaching import ReachingTask
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.simulation import TrapperSimulation
from torchdyn_plan.envs.trapping import is_pocketed
from torchdyn_plan.errors import InputError
from torchdyn_plan.files import write_json, write_whole
from torchdyn_plan.planners import STATIC_PLANNERS, PolicyPlanner, StaticPlanner
from torchdyn_plan.training.reach_data import record_fetch_runs, record_goal_paths
from torchdyn_plan.training.runs import record_runs, trapper_runs
from torchdyn_plan.versions import library_versions

PATH_STEPS = 2000
"""Control steps of a recorded path: four times an episode (paper, Section IV)."""
FASTEST = 5.0
"""Balls start with velocities up to this [m/s]."""


def collect(arguments: CollectArguments, planner: StaticPlanner | None = None, *, name: str = "own") -> None:
    """Write the shards that ``arguments`` ask for, and a description of them; whole shards that there are are kept.

    Args:
        arguments: what, how much and where to.
        planner: a person's own static planner, whose arrivals are measured in place of those of ``arguments.static``.
        name: what the description calls it.

    Raises:
        InputError: a shard that is there was made in another scene or otherwise than ``arguments`` say, or is damaged.
        OutputError: the folder cannot be written to.
    """
    from tqdm import tqdm

    torch.set_num_threads(1)
    static = arguments.static if planner is None else name
    driver = planner or _driver(arguments)
    scene = task_digest(arguments.task)
    record = RECORDERS[arguments.task, arguments.what]
    shards = -(-arguments.episodes // SHARD[arguments.what])
    for index in tqdm(range(shards), desc=f"collect {arguments.what}", unit="shard"):
        path = arguments.out / f"{arguments.what}-{arguments.seed}-{index:03d}.safetensors"
        made = _made(arguments, scene, index, static)
        if path.exists() and _is_kept(path, made):
            continue
        tensors = record(arguments, index, driver)
        write_whole(path, lambda temporary, tensors=tensors, made=made: save_file(tensors, temporary, made))
    fields = {key: str(value) if isinstance(value, Path) else value for key, value in _fields(arguments).items()}
    fields["static"] = static
    about = {"arguments": fields, "scene": scene, "versions": library_versions()}
    write_json(arguments.out / f"{arguments.what}-{arguments.seed}.json", about)


SHARD = {"paths": 1024, "arrivals": 2048}
"""Episodes in a shard."""


def _fields(arguments: CollectArguments) -> dict[str, Any]:
    return dataclasses.asdict(arguments)


def _made(arguments: CollectArguments, scene: str, index: int, static: str) -> dict[str, str]:
    """What decides a shard's numbers: its metadata."""
    episodes = sum(map(len, _shard_rows(arguments, index)))
    shared = {"scene": scene, "num_envs": str(arguments.num_envs), "episodes": str(episodes)}
    if arguments.what == "paths":
        return shared
    weights = {} if arguments.weights is None else {"weights": _digest(policy_file(arguments.weights))}
    return shared | {"static": static} | weights


def _is_kept(path: Path, made: dict[str, str]) -> bool:
    """Whether the shard at ``path`` is as it would be ``made``; not one that another number of episodes cut short."""
    try:
        with safe_open(path, framework="pt") as content:
            there = content.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise InputError(f"{str(path)!r} is not a whole safetensors file: {error}") from error
    differing = [name for name in made if there.get(name, made[name]) != made[name]]
    for name in differing:
        if name != "episodes":
            raise InputError(
                f"{str(path)!r} is of another collection: {name} is {there[name]} there, {made[name]} here"
            )
    return not differing


def _shard_rows(arguments: CollectArguments, index: int) -> Iterator[Tensor]:
    """Episode numbers of a shard, ``num_envs`` at a time."""
    size = SHARD[arguments.what]
    last = min((index + 1) * size, arguments.episodes)
    for first in range(index * size, last, arguments.num_envs):
        yield torch.arange(first, min(first + arguments.num_envs, last))


def _paths(arguments: CollectArguments, index: int, _: StaticPlanner) -> dict[str, Tensor]:
    """Balls rolled alone (the arm at home touches none), each at a velocity of its own up to `FASTEST`."""
    scene, paths, speeds = TrapperScene(), [], []
    for episodes in _shard_rows(arguments, index):
        place, velocity = draw_starts(scene, episodes, velocity=1.0, split="train", seed=arguments.seed)
        draw = torch.Generator().manual_seed(arguments.seed * 1_000_003 + int(episodes[0]))
        speed = FASTEST * torch.rand(len(episodes), generator=draw, dtype=torch.float64)
        paths.append(_record(scene, place, velocity * speed.unsqueeze(-1), PATH_STEPS, threads=arguments.threads))
        speeds.append(speed.float())
    return _flatten(torch.cat(paths), torch.cat(speeds), scene)


def roll(
    scene: TrapperScene, episodes: Tensor, *, steps: int, velocity: float, friction: float, split: str, seed: int
) -> dict[str, Tensor]:
    """Balls of ``episodes`` rolled alone for ``steps`` control steps, at ``friction`` [N]: entries as of a shard."""
    place, speed = draw_starts(scene, episodes, velocity=velocity, split=split, seed=seed)
    paths = _record(scene, place, speed, steps, friction=friction, threads=1)
    return _flatten(paths, torch.full((len(episodes),), velocity), scene)


def _record(
    scene: TrapperScene, place: Tensor, velocity: Tensor, steps: int, *, friction: float = 0.0, threads: int
) -> Tensor:
    """Positions ``(M, steps + 1, 3)`` [m, world] of balls that start at ``place`` with ``velocity``, (M, 2) each."""
    simulation = TrapperSimulation(len(place), scene, friction=friction, num_threads=threads, arm=False)
    simulation.reset(torch.arange(len(place)), place, velocity)
    record = torch.empty(len(place), steps + 1, 3)
    record[:, 0] = simulation.ball_pos
    for step in range(1, steps + 1):
        simulation.step()
        record[:, step] = simulation.ball_pos
    return record


def _flatten(paths: Tensor, speeds: Tensor, scene: TrapperScene) -> dict[str, Tensor]:
    """Cut each path where its ball is swallowed and lay them end to end."""
    sunk = is_pocketed(scene, paths)
    pocketed = sunk.any(-1)
    length = torch.where(pocketed, sunk.to(torch.int64).argmax(-1) + 1, paths.shape[1])
    kept = torch.arange(paths.shape[1]) < length.unsqueeze(-1)
    start = length.cumsum(0) - length
    return {"positions": paths[kept], "start": start, "length": length, "pocketed": pocketed, "velocity": speeds}


def policy_file(weights: Path) -> Path:
    """File of the policy that is a file, or lies in a folder of its training; raises `InputError` if there is none."""
    choices = (weights, weights / "policy.safetensors", weights / "policy" / "policy.safetensors")
    for choice in choices:
        if choice.is_file():
            return choice
    raise InputError(f"no policy at {str(weights)!r}: it is neither a file nor a folder of a training")


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()[:16]


def _driver(arguments: CollectArguments) -> StaticPlanner:
    """The static planner that ``arguments`` name."""
    if arguments.weights is None:
        return STATIC_PLANNERS[arguments.task][arguments.static]()
    return PolicyPlanner.from_pretrained(policy_file(arguments.weights))


def _arrivals(arguments: CollectArguments, index: int, planner: StaticPlanner) -> dict[str, Tensor]:
    """Runs of the static planner, whole sequences of every arm."""
    scene = TrapperScene()
    task = ReachingTask(planner, arguments.num_envs, scene=scene, num_threads=arguments.threads)
    runs = trapper_runs(scene, restless=getattr(planner, "restless", False))
    draw = torch.Generator().manual_seed(arguments.seed * 1_000_003 + index)
    parts = [record_runs(task, runs, draw) for _ in _shard_rows(arguments, index)]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _goal_paths(arguments: CollectArguments, index: int, _: StaticPlanner) -> dict[str, Tensor]:
    """Goals of Reach, no gripper near."""
    return record_goal_paths(torch.cat(list(_shard_rows(arguments, index))), seed=arguments.seed)


def _fetch_arrivals(arguments: CollectArguments, index: int, planner: StaticPlanner) -> dict[str, Tensor]:
    """Runs of the static planner of the Fetch arm."""
    return record_fetch_runs(
        planner, arguments.num_envs, len(list(_shard_rows(arguments, index))),
        seed=arguments.seed * 1_000_003 + index, num_threads=arguments.threads,
    )  # fmt: skip


RECORDERS = {
    ("trapper", "paths"): _paths,
    ("trapper", "arrivals"): _arrivals,
    ("reach", "paths"): _goal_paths,
    ("reach", "arrivals"): _fetch_arrivals,
}
"""What fills a shard, for each task and kind of data."""


def task_digest(task: str) -> str:
    """Hash of the scene that a task's data belongs to."""
    return TrapperScene().digest() if task == "trapper" else fetch_digest()
