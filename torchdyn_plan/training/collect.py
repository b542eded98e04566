"""Collection of training data in shards: paths of targets, arrivals of static planners, attempts at a capture."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice, check_count, check_seed, check_threads
from torchdyn_plan.errors import InputError
from torchdyn_plan.files import exists, read_metadata, short_path, write_json, write_tensors
from torchdyn_plan.nets.policy import Actor
from torchdyn_plan.planners import PolicyPlanner, StaticPlanner
from torchdyn_plan.progress import progress_bar
from torchdyn_plan.tasks.task import Task, load_task
from torchdyn_plan.threads import one_thread
from torchdyn_plan.training import shards
from torchdyn_plan.training.shards import check_made, content_digest, shard_path, shard_sizes, surplus_shards
from torchdyn_plan.training.tracks import at_control_steps, read_tracks, shard_of
from torchdyn_plan.versions import library_versions

ENTRIES = {
    "paths": ("positions", "start", "length", "pocketed", "velocity"),
    "arrivals": ("robot_state", "goal", "arrival", "nearest", "run"),
    "captures": ("window", "goal", "captured", "run"),
}
"""Tensors in a shard of each kind of data."""
SERIES = 1_000_003
"""Draws are seeded by this number times the series' seed plus an index, so that no two series share a seed."""


def collect(
    task: Task | str,
    what: str,
    out: Path,
    *,
    episodes: int = 20_000,
    seed: int = 0,
    num_envs: int = 256,
    num_threads: int = 0,
    static: str | None = None,
    weights: Path | None = None,
    planner: StaticPlanner | None = None,
    name: str = "own",
) -> None:
    """Write shards of data and their description into ``out``; existing complete shards are kept.

    Args:
        task: a task, or its name.
        what: ``paths`` of targets for a forecaster, ``arrivals`` of a static planner for an arrival-time network, or
            ``captures``, attempts of the task's best planner and what came of them, for a capture network.
        out: folder; it may hold all three kinds of one scene.
        episodes: paths, sequences of runs, or episodes with attempts.
        seed: series of episodes.
        num_envs: episodes that run in parallel; random numbers are drawn for the whole block.
        num_threads: of the simulation, 0 for all cores; does not change the data.
        static: name of the static planner whose arrivals or captures are recorded; the task's default for None.
        weights: policy of that static planner, a file or a folder of its training; the shipped one for None.
        planner: your own static planner, whose arrivals are measured instead of those of ``static``.
        name: name of ``planner`` in the description.

    Raises:
        InputError: the task records no such data, an argument is wrong, or an existing shard is damaged or was made in
            another scene or with other arguments.
        WeightsError: there are no such weights.
        OutputError: the folder cannot be written to.
    """
    task = load_task(task)
    check_choice("kind of data", what, shards.SHARD)
    if weights is not None and (what != "arrivals" or planner is not None):
        raise InputError(
            f"weights are for the task's own static planner: give either weights or a planner, got {weights}"
        )
    driver = name if planner is not None else static or task.default_static
    file = None if weights is None else str(Actor.find(weights))
    wanted = _Wanted(task.name, what, str(out), episodes, seed, num_envs, num_threads, driver, file)
    for surplus in surplus_shards(out, what, seed, wanted.shards):
        raise InputError(
            f"{short_path(surplus)} lies beyond the {episodes} episodes asked for: ask for as many as there are, or "
            "delete it"
        )
    with one_thread():
        record = _recorder(task, wanted, planner)
        for index in progress_bar(range(wanted.shards), desc=f"collect {what}", unit="shard"):
            path = shard_path(out, what, seed, index)
            made = wanted.metadata(index, task.digest())
            if exists(path) and not check_made(path, made):
                continue
            tensors = _whole(wanted, record(index))
            write_tensors(path, tensors, made | {"shard": path.stem, "content": content_digest(tensors)})
    about = {"arguments": asdict(wanted), "scene": task.digest(), "versions": library_versions()}
    write_json(out / f"{what}-{seed}.json", about)


def collect_tracks(task: Task | str, file: Path, out: Path, *, seed: int = 0) -> int:
    """Write recorded targets into ``out``, in the format of `collect`'s paths; returns their number.

    Args:
        task: the task to whose control step they are resampled, or its name.
        file: see `torchdyn_plan.training.tracks.read_tracks`.
        out: folder.
        seed: number of their series.

    Raises:
        InputError: the file is invalid (the message names row and column), fewer than two tracks are long enough for
            the task's forecaster, or the folder holds other data.
        OutputError: the folder cannot be written to.
    """
    task = load_task(task)
    check_seed(seed)
    paths = at_control_steps(read_tracks(file), task.control_step)
    _check_long_enough(task, file, paths)
    wanted = _Wanted(task.name, "paths", str(out), len(paths), seed, 1, 1, "", None, str(file))
    for surplus in surplus_shards(out, "paths", seed, wanted.shards):
        raise InputError(f"{short_path(surplus)} holds other paths: give another folder or seed, or delete it")
    size = shards.SHARD["paths"]
    for index in range(wanted.shards):
        tensors = shard_of(paths[index * size : (index + 1) * size], task.control_step)
        path, content = shard_path(out, "paths", seed, index), content_digest(tensors)
        if exists(path) and read_metadata(path, InputError).get("content") != content:
            raise InputError(f"{short_path(path)} holds other paths: give another folder or seed, or delete it")
        made = {"scene": task.digest(), "num_envs": "1", "episodes": str(len(tensors["length"]))}
        write_tensors(path, tensors, made | {"shard": path.stem, "content": content})
    about = {"arguments": asdict(wanted), "scene": task.digest(), "versions": library_versions()}
    write_json(out / f"paths-{seed}.json", about)
    return len(paths)


def _check_long_enough(task: Task, file: Path, paths: list[Tensor]) -> None:
    """Raise `InputError` unless two of ``paths`` are long enough for a window: one for training, one held out."""
    needed = 2
    if task.fitting is not None:
        fitting = task.fitting()
        needed = fitting.forecaster.horizon + fitting.windows.first_step + 1
    if sum(len(path) >= needed for path in paths) < 2:
        longest = max(map(len, paths), default=0)
        raise InputError(
            f"{short_path(Path(file))} needs 2 tracks of {needed} control steps of {task.control_step:g} s, which the "
            f"forecaster of {task.name} sees and looks ahead, got {len(paths)} tracks of up to {longest}"
        )


@dataclass(frozen=True)
class _Wanted:
    """The arguments of a collection, as stored in its description."""

    task: str
    what: str
    out: str
    episodes: int
    seed: int
    num_envs: int
    num_threads: int
    static: str
    weights: str | None = None
    tracks: str | None = None

    def __post_init__(self) -> None:
        check_count("episodes", self.episodes)
        check_count("num_envs", self.num_envs)
        check_seed(self.seed)
        check_threads("num_threads", self.num_threads)

    @property
    def shards(self) -> int:
        """Number of shards."""
        return len(shard_sizes(self.what, self.episodes))

    def blocks(self, index: int) -> list[Tensor]:
        """Episode numbers of a shard, ``num_envs`` at a time."""
        size = shards.SHARD[self.what]
        last = min((index + 1) * size, self.episodes)
        starts = range(index * size, last, self.num_envs)
        return [torch.arange(first, min(first + self.num_envs, last)) for first in starts]

    def metadata(self, index: int, scene: str) -> dict[str, str]:
        """Everything that determines the content of a shard, except its name."""
        episodes = sum(map(len, self.blocks(index)))
        made = {"scene": scene, "num_envs": str(self.num_envs), "episodes": str(episodes)}
        if self.what != "paths":
            made["static"] = self.static
        if self.weights is not None:
            made["weights"] = hashlib.sha256(Path(self.weights).read_bytes()).hexdigest()[:16]
        return made


def _recorder(task: Task, wanted: _Wanted, planner: StaticPlanner | None) -> Callable[[int], dict[str, Tensor]]:
    """The function that records a shard by its index; raises `InputError` if the task has none."""
    threads = wanted.num_threads
    if wanted.what == "paths":
        record_paths = task.record_paths
        if record_paths is None:
            raise InputError(f"{task.name} records no paths: give a file of tracks, by --from")
        return lambda index: record_paths(wanted.blocks(index), seed=wanted.seed, num_threads=threads)
    if wanted.what == "captures":
        record_captures = task.record_captures
        if record_captures is None:
            raise InputError(f"{task.name} records no captures")
        return lambda index: record_captures(wanted.static, wanted.blocks(index), seed=wanted.seed, num_threads=threads)
    record_arrivals = task.record_arrivals
    if record_arrivals is None:
        raise InputError(f"{task.name} records no arrivals")
    driver = planner or _static_planner(task, wanted)
    return lambda index: record_arrivals(
        driver,
        num_envs=wanted.num_envs,
        sequences=len(wanted.blocks(index)),
        seed=wanted.seed * SERIES + index,
        num_threads=threads,
    )


def _static_planner(task: Task, wanted: _Wanted) -> Any:
    made = task.static_planner(wanted.static, weights=wanted.weights)
    if wanted.weights is not None and not isinstance(made, PolicyPlanner):
        raise InputError(
            f"weights are for a policy, but {wanted.static} of {task.name} is not one: got {wanted.weights}"
        )
    return made


def _whole(wanted: _Wanted, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The recorded tensors, ready to be written; raises `InputError` if the task's recorder left something out."""
    missing = [name for name in ENTRIES[wanted.what] if name not in tensors]
    if missing:
        raise InputError(f"what {wanted.task} records of {wanted.what} lacks {', '.join(missing)}")
    return {name: value.contiguous() for name, value in tensors.items()}
