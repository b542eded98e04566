"""Which episodes can be solved at all, by the paper's definition with measured arrival times (Section IV-B)."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan.envs.trapper.arm_runner import TrapperArmRunner
from torchdyn_plan.envs.trapper.contact import is_pocketed
from torchdyn_plan.envs.trapper.scene import TrapperScene, trapper_scene
from torchdyn_plan.envs.trapper.simulation import TrapperSimulation
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.errors import OutputError, WeightsError
from torchdyn_plan.files import read_tensors, write_tensors
from torchdyn_plan.progress import progress_bar
from torchdyn_plan.tasks.task import Truth
from torchdyn_plan.tasks.trapper.task import trapper_task

HORIZON = 300
"""Control steps for which the truth is recorded beyond the end of an episode."""

SPACING = 0.02
"""Greatest distance between neighbouring points of a map [m]."""
LONGEST = 500
"""Control steps after which an arm that has not arrived never does."""
NEVER = 2**20
"""Arrival at a place that the arm never reaches [control steps]."""
SHIPPED = Path(__file__).parents[2] / "weights"
"""Folder of the maps that come with the package."""


class ArrivalMap(NamedTuple):
    """Measured control steps from rest at home until a ball at a place of the table would be covered."""

    steps: Tensor
    """``(n, n)`` int64, x by y over the whole table; `NEVER` where the arm does not arrive."""
    half_side: float
    """Half of the table's side: the grid runs from -half_side to half_side [m]."""

    def at(self, place: Tensor) -> Tensor:
        """Steps at the map's point next to ``place`` (*B, 2 or 3) [m, world]: ``(*B,)`` int64."""
        last = len(self.steps) - 1
        index = ((place[..., :2] / self.half_side + 1.0) * (last / 2)).round().long()
        inside = ((index >= 0) & (index <= last)).all(-1)
        index = index.clamp(0, last)
        return torch.where(inside, self.steps[index[..., 0], index[..., 1]], NEVER)


def record_truth(
    velocity: float,
    friction: float,
    *,
    scene: TrapperScene | str,
    episodes: int,
    seed: int,
    split: str,
    static: str,
    num_threads: int = 0,
) -> Truth:
    """Where the balls of episodes 0 … E-1 roll, and which of them the arm can be at in time.

    Args:
        velocity: of the balls at the start [m/s].
        friction: their friction loss [N].
        scene: that they roll in, or its name.
        episodes: number E of episodes.
        seed: which series of episodes.
        split: which family of series.
        static: name of the static planner that drives the arm.
        num_threads: of the simulation, 0 for all cores.
    """
    task, room = trapper_task(scene), trapper_scene(scene)
    driver = task.static_planner(static, chunk=task.rows_at_once[1])
    arrivals = arrival_map(static, driver, room, num_threads=num_threads)
    place, speed = draw_starts(room, torch.arange(episodes), velocity=velocity, split=split, seed=seed)
    steps = task.max_steps + HORIZON
    path = record_path(room, place, speed, steps=steps, friction=friction, num_threads=num_threads)
    return Truth(path, is_solvable(arrivals, room, path[:, : task.max_steps + 1]))


def is_solvable(arrivals: ArrivalMap, scene: TrapperScene, path: Tensor) -> Tensor:
    """Whether for some t the arm, from rest at home, can be at the ball's place at step t within t steps: ``(*B,)``.

    Args:
        arrivals: measured arrivals of the static planner.
        scene: where pockets are deep.
        path: ``(*B, T, 3)`` true positions of the ball at steps 0 … T-1, the arm held still [m, world].
    """
    in_time = arrivals.at(path) <= torch.arange(path.shape[-2])
    return (in_time & ~is_pocketed(scene, path)).any(-1)


def record_path(
    scene: TrapperScene, place: Tensor, velocity: Tensor, *, steps: int, friction: float = 0.0, num_threads: int = 0
) -> Tensor:
    """True positions ``(M, steps + 1, 3)`` [m, world] of balls that start at ``place`` with ``velocity``, (M, 2) each.

    The arm's home pose touches no ball, so the ball rolls alone.
    """
    simulation = TrapperSimulation(len(place), scene, friction=friction, num_threads=num_threads, arm=False)
    simulation.reset(torch.arange(len(place)), place, velocity)
    path = torch.empty(len(place), steps + 1, 3)
    path[:, 0] = simulation.ball_pos
    for step in range(1, steps + 1):
        simulation.step()
        path[:, step] = simulation.ball_pos
    return path


def measure_arrivals(
    planner: Callable[[TensorDictBase], TensorDictBase],
    scene: TrapperScene,
    *,
    spacing: float = SPACING,
    num_threads: int = 0,
) -> ArrivalMap:
    """Run ``planner`` from home to each point of a grid over the table, ``spacing`` [m] apart, until it is there."""
    count = int(-(-scene.table_side // spacing)) + 1
    line = torch.linspace(-scene.half_side, scene.half_side, count)
    grid = torch.cartesian_prod(line, line)
    goals = torch.cat([grid, torch.full((len(grid), 1), scene.ball_radius)], dim=-1)
    arms = TrapperArmRunner(planner, len(goals), scene=scene, num_threads=num_threads)
    arrived = torch.full((len(goals),), NEVER)
    for step in progress_bar(range(LONGEST + 1), desc="measure arrivals", unit="step", leave=False):
        arrived = torch.where((arrived == NEVER) & arms.is_reached(goals), step, arrived)
        arms.step(goals)
    return ArrivalMap(arrived.view(count, count), scene.half_side)


def arrival_map(
    static: str, planner: Callable[[TensorDictBase], TensorDictBase], scene: TrapperScene, *, num_threads: int = 0
) -> ArrivalMap:
    """The map of the static planner called ``static`` in ``scene``: shipped, cached, or measured now and cached."""
    name = arrivals_name(static, scene)
    for folder in (SHIPPED, _cache()):
        steps = _load(folder / name)
        if steps is not None:
            return ArrivalMap(steps.long(), scene.half_side)
    arrivals = measure_arrivals(planner, scene, num_threads=num_threads)
    # A map that cannot be kept is as good as any other.
    with contextlib.suppress(OutputError):
        save_arrivals(arrivals, _cache() / name)
    return arrivals


def arrivals_name(static: str, scene: TrapperScene) -> str:
    """Name of the file that holds the map of a static planner in a scene."""
    return f"arrivals-{static}-{scene.digest()}.safetensors"


def save_arrivals(arrivals: ArrivalMap, path: Path) -> None:
    """Write the map to ``path``, whole or not at all."""
    write_tensors(path, {"steps": arrivals.steps.int()})


def _load(path: Path) -> Tensor | None:
    """Steps in the file; None if there is none, or a damaged one, which is measured again."""
    try:
        _, content = read_tensors(path, WeightsError)
    except WeightsError:
        return None
    steps = content.get("steps")
    if steps is None or steps.dtype != torch.int32 or steps.ndim != 2 or steps.shape[0] != steps.shape[1]:
        return None
    # An arrival is a number of control steps, or never.
    known = ((steps >= 0) & (steps <= LONGEST)) | (steps == NEVER)
    return steps if len(steps) and bool(known.all()) else None


def _cache() -> Path:
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchdyn_plan"
    except RuntimeError:
        # Nobody's home.
        return Path(tempfile.gettempdir()) / "torchdyn_plan"
