"""Training data by simulation: paths of the rolling ball, and arrivals of a static planner."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan.cli_arguments import CollectArguments
from torchdyn_plan.envs.episodes import draw_starts
from torchdyn_plan.envs.reaching import ReachingTask
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.simulation import TrapperSimulation
from torchdyn_plan.envs.trapping import is_pocketed
from torchdyn_plan.errors import InputError
from torchdyn_plan.files import write_json, write_whole
from torchdyn_plan.planners.ik import IKPlanner
from torchdyn_plan.versions import library_versions

PATH_STEPS = 2000
"""Control steps of a recorded path: four times an episode (paper, Section IV)."""
FASTEST = 5.0
"""Balls start with velocities up to this [m/s]."""
STATES_PER_RUN = 5
"""Intermediate states taken from each run of the static planner (paper, Section III-B.3)."""
RUN_STEPS = 220
"""Control steps that a run may take after its goal was given."""
SWITCH_STEPS = 120
"""The goal of a run is given within this many steps of another motion that starts at home."""
AT_HOME = 0.15
"""Share of runs whose goal is given at home, at rest."""
STATIC_PLANNERS: dict[str, Callable[[], Callable[[TensorDictBase], TensorDictBase]]] = {"ik": IKPlanner}


def collect(arguments: CollectArguments) -> None:
    """Write the shards that ``arguments`` ask for, and a description of them; whole shards that there are are kept.

    Raises:
        InputError: a shard that is there was made in another scene or otherwise than ``arguments`` say, or is damaged.
        OutputError: the folder cannot be written to.
    """
    from tqdm import tqdm

    scene = TrapperScene()
    torch.set_num_threads(1)
    record = {"paths": _paths, "arrivals": _arrivals}[arguments.what]
    shards = -(-arguments.episodes // SHARD[arguments.what])
    for index in tqdm(range(shards), desc=f"collect {arguments.what}", unit="shard"):
        path = arguments.out / f"{arguments.what}-{arguments.seed}-{index:03d}.safetensors"
        made = _made(arguments, scene, index)
        if path.exists() and _is_kept(path, made):
            continue
        tensors = record(arguments, scene, index)
        write_whole(path, lambda temporary, tensors=tensors, made=made: save_file(tensors, temporary, made))
    fields = {name: str(value) if isinstance(value, Path) else value for name, value in _fields(arguments).items()}
    about = {"arguments": fields, "scene": scene.digest(), "versions": library_versions()}
    write_json(arguments.out / f"{arguments.what}-{arguments.seed}.json", about)


SHARD = {"paths": 1024, "arrivals": 4096}
"""Episodes in a shard."""


def _fields(arguments: CollectArguments) -> dict[str, Any]:
    return dataclasses.asdict(arguments)


def _made(arguments: CollectArguments, scene: TrapperScene, index: int) -> dict[str, str]:
    """What decides a shard's numbers: its metadata."""
    episodes = sum(map(len, _shard_rows(arguments, index)))
    shared = {"scene": scene.digest(), "num_envs": str(arguments.num_envs), "episodes": str(episodes)}
    return shared | ({"static": arguments.static} if arguments.what == "arrivals" else {})


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


def _paths(arguments: CollectArguments, scene: TrapperScene, index: int) -> dict[str, Tensor]:
    """Balls rolled alone (the arm at home touches none), each at a velocity of its own up to `FASTEST`."""
    paths, speeds = [], []
    for episodes in _shard_rows(arguments, index):
        simulation = TrapperSimulation(len(episodes), scene, num_threads=arguments.threads, arm=False)
        place, velocity = draw_starts(scene, episodes, velocity=1.0, split="train", seed=arguments.seed)
        draw = torch.Generator().manual_seed(arguments.seed * 1_000_003 + int(episodes[0]))
        speed = FASTEST * torch.rand(len(episodes), generator=draw, dtype=torch.float64)
        simulation.reset(torch.arange(len(episodes)), place, velocity * speed.unsqueeze(-1))
        record = torch.empty(len(episodes), PATH_STEPS + 1, 3)
        record[:, 0] = simulation.ball_pos
        for step in range(1, PATH_STEPS + 1):
            simulation.step()
            record[:, step] = simulation.ball_pos
        paths.append(record)
        speeds.append(speed.float())
    return _flatten(torch.cat(paths), torch.cat(speeds), scene)


def _flatten(paths: Tensor, speeds: Tensor, scene: TrapperScene) -> dict[str, Tensor]:
    """Cut each path where its ball is swallowed and lay them end to end."""
    sunk = is_pocketed(scene, paths)
    pocketed = sunk.any(-1)
    length = torch.where(pocketed, sunk.to(torch.int64).argmax(-1) + 1, paths.shape[1])
    kept = torch.arange(paths.shape[1]) < length.unsqueeze(-1)
    start = length.cumsum(0) - length
    return {"positions": paths[kept], "start": start, "length": length, "pocketed": pocketed, "velocity": speeds}


def _arrivals(arguments: CollectArguments, scene: TrapperScene, index: int) -> dict[str, Tensor]:
    """Runs of the static planner from home, most of them redirected on their way to another goal or at it."""
    task = ReachingTask(
        STATIC_PLANNERS[arguments.static](), arguments.num_envs, scene=scene, num_threads=arguments.threads
    )
    draw = torch.Generator().manual_seed(arguments.seed * 1_000_003 + index)
    parts = []
    for episodes in _shard_rows(arguments, index):
        runs = _run(task, draw)
        parts.append({name: value[: len(episodes)].flatten(0, 1) for name, value in runs.items()})
    shard = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    settled = shard.pop("settled")
    return {name: value[settled].contiguous() for name, value in shard.items()}


def _run(task: ReachingTask, draw: torch.Generator) -> dict[str, Tensor]:
    """One run of every arm: `STATES_PER_RUN` states each, with their goals and the steps that were left to arrival."""
    task.reset()
    count = task.simulation.num_envs
    before, goal = draw_goals(task.scene, count, draw), draw_goals(task.scene, count, draw)
    given = torch.randint(SWITCH_STEPS, (count,), generator=draw)
    given[torch.rand(count, generator=draw) < AT_HOME] = 0
    states = torch.empty(SWITCH_STEPS + RUN_STEPS + 1, count, task.robot_state.shape[-1])
    arrived = torch.full((count,), -1)
    for step in range(SWITCH_STEPS + RUN_STEPS + 1):
        states[step] = task.robot_state
        now = (step >= given) & (arrived < 0) & task.is_reached(goal)
        arrived = torch.where(now, step, arrived)
        task.step(torch.where((step >= given).unsqueeze(-1), goal, before))
    never = arrived < 0
    moving = states[-1, :, 6:12].abs().amax(-1) > 0.05
    last = torch.where(never, given + RUN_STEPS // 2, arrived)
    share = torch.rand(count, STATES_PER_RUN, generator=draw)
    share[:, 0] = 0.0
    taken = (given.unsqueeze(-1) + share * (last - given + 1).unsqueeze(-1)).long().clamp(max=len(states) - 1)
    rows = torch.arange(count).unsqueeze(-1)
    steps = torch.where(never.unsqueeze(-1), -1, arrived.unsqueeze(-1) - taken)
    return {
        "robot_state": states[taken, rows],
        "goal": goal.unsqueeze(1).expand(-1, STATES_PER_RUN, -1),
        "arrival": steps,
        "run": rows.expand(-1, STATES_PER_RUN) + torch.randint(2**40, (1,), generator=draw),
        "settled": ~(never & moving).unsqueeze(-1).expand(-1, STATES_PER_RUN),
    }


def draw_goals(scene: TrapperScene, count: int, draw: torch.Generator) -> Tensor:
    """Goals ``(count, 3)`` [m, world]: on the table and above it, near the arm, all over, and beyond the rails."""
    kind, height = torch.rand(2, count, generator=draw)
    flat = 2.0 * torch.rand(count, 2, generator=draw) - 1.0
    angle, radius = torch.rand(2, count, generator=draw)
    turn, reach = torch.pi * angle, 0.15 + 0.9 * radius.sqrt()
    near = torch.stack([reach * turn.cos(), reach * turn.sin()], -1) + torch.tensor(scene.base_pos[:2])
    place = torch.where((kind < 0.5).unsqueeze(-1), near, flat * scene.half_side)
    place = torch.where((kind > 0.9).unsqueeze(-1), flat * 3.0, place)
    low = scene.ball_radius + 0.005 * (2.0 * torch.rand(count, generator=draw) - 1.0)
    high = scene.ball_radius + 0.015 + 0.25 * torch.rand(count, generator=draw)
    sunk = -0.1 * torch.rand(count, generator=draw)
    z = torch.where(height < 0.6, low, torch.where(height < 0.97, high, sunk))
    return torch.cat([place, z.unsqueeze(-1)], dim=-1)
