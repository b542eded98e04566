"""What each command takes; `torchdyn_plan.cli.forms` adds what a task has to choose from.

Types alone are settled here: values are checked by what they are handed to, so that Python and the command line say the
same.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from torchdyn_plan.tasks import DEFAULT

BENCHMARKS = {
    "replan": "torchdyn_plan.bench.replan",
    "env": "torchdyn_plan.bench.env",
    "kinematics": "torchdyn_plan.bench.kinematics",
    "all": "torchdyn_plan.bench.series",
}
"""Name of each benchmark, and the module whose ``bench()`` measures and whose ``plot``, if any, draws the rows."""

DATA, TRAINING = Path("runs/data"), Path("runs/training")
"""Folders of collected data and of trainings, a folder in them for each task and static planner."""


def default_folder(base: Path, task: str, static: str = "") -> Path:
    """Where the data or networks of ``task`` lie, those of a ``static`` planner apart from another's."""
    name = f"{task}-{static}" if static else task
    # A task of another module is called by its place.
    return base / name.replace(":", ".").replace("/", ".")


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What every command takes; its task and scene are read from the words before anything else."""

    task: str = DEFAULT


@dataclass(frozen=True, kw_only=True)
class TrackArguments:
    """What a track is told; its own where not given, and not every track has each."""

    noise: float | None = None
    """Standard deviation of a measurement's error along each axis [m]; the sensor's when not given."""
    speed: float | None = None
    """Standard deviation of the speed along each axis of a target of which nothing is known [m/s]."""
    max_speed: float | None = None
    """No target moves faster [m/s]."""
    gate: float | None = None
    """A measurement fits up to so many standard deviations of what is expected of it."""
    rebound: float | None = None
    """Share of the speed that is taken to come back from a bounce."""
    patience: float | None = None
    """So long a track is of use without a measurement [s]."""
    least: int | None = None
    """Measurements from which on a track is of use."""
    oldest: float | None = None
    """A measurement older than the newest one by more than this is not used [s]."""
    window: float | None = None
    """Of least_squares: time over which a measurement's weight falls to 1/e [s]."""
    agility: float | None = None
    """Of kalman: after t seconds the velocity may have changed by this times the root of t [m/s² per √Hz]."""
    accelerates: bool | None = None
    """Of kalman: whether the acceleration is constant, and not the velocity."""
    acceleration: float | None = None
    """Of kalman that accelerates: standard deviation of an acceleration of which nothing is known [m/s²]."""


@dataclass(frozen=True, kw_only=True)
class EpisodeArguments(Arguments):
    """Which episodes are run, and by which planners."""

    planners: tuple[str, ...] = ()
    static: str = ""
    settings: Any = None
    weights: Path | None = None
    """Folder of the planners' networks, as train leaves it; those that ship when not given."""
    episodes: int = 100
    """Number of episodes for each planner, always episodes 0 to N-1; of a sweep for each value and repeat."""
    seed: int = 0
    """Which series of episodes; of a sweep the first one."""
    split: str = "test"
    """Which family of series: test, or dev for tuning."""
    num_envs: int = 64
    """Episodes that run side by side; does not change the results."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores; does not change the results."""
    latency_ms: float = 0.0
    """Time by which every plan comes late, whole control steps; planners that make no plans have none."""
    sensor: Any = None
    track: str = "none"
    track_settings: Any = None
    compensate: bool = True
    """Tell the planners of that time, so that they plan for the moment when the plan is there."""
    overwrite: bool = False
    """Take the place of results of something else that the folder holds; otherwise they are left, and refused."""


@dataclass(frozen=True, kw_only=True)
class EvaluateArguments(EpisodeArguments):
    """Run episodes at one setting with each planner; print a table and write the results."""

    out: Path | None = None
    """Folder for results.json, episodes.json and the plot; nothing is written without it."""


@dataclass(frozen=True, kw_only=True)
class SweepArguments(EpisodeArguments):
    """Evaluate along the values of one setting; a killed sweep continues."""

    over: str
    out: Path
    """Folder of the sweep: its points, results.json and the plot. One that holds points already is continued."""
    values: tuple[float, ...] = ()
    """Values of the setting; the paper's when none are given, or the task's."""
    repeats: int = 10
    """Series of episodes for each value, with seeds upwards from the first."""


@dataclass(frozen=True, kw_only=True)
class ReportArguments:
    """Draw the figures of the papers with the results of sweeps in them, as SVG and PNG."""

    out: Path
    """Folder for the figures, and for report.json with their points."""
    results: Path | None = None
    """Folder with the results of sweeps, at any depth; benchmarks/results of the checkout when not given."""


@dataclass(frozen=True, kw_only=True)
class CollectArguments(Arguments):
    """Gather training data: paths of targets nobody touches, or arrival times of a static planner."""

    what: str
    static: str = ""
    out: Path | None = None
    """Folder for the shards of data; runs/data/TASK-STATIC when not given."""
    weights: Path | None = None
    """Of a static planner that is a policy: a file, or a folder of its training; the one that ships when not given."""
    tracks: Path | None = None
    episodes: int = 20000
    """Number of targets, or of sequences of runs of the static planner."""
    seed: int = 0
    """Which series of episodes."""
    num_envs: int = 256
    """Episodes that run side by side."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores."""


@dataclass(frozen=True, kw_only=True)
class TrainArguments(Arguments):
    """Train a network, on collected data or by trial; a killed run continues where its folder stands."""

    out: Path | None = None
    """Folder for checkpoints, curve and weights, in which each network has its own; when not given,
    runs/training/TASK-STATIC, and of policies runs/training/TASK."""
    steps: int | None = None
    """Optimiser steps; the recipe's own when not given."""
    batch: int | None = None
    """Samples a step; the recipe's own when not given."""
    lr: float | None = None
    """Highest learning rate; the recipe's own when not given."""
    seed: int = 0
    """Seed of initialisation and sampling."""
    device: str = "cpu"
    """Where to train: cpu, cuda, cuda:1, …"""
    resume: bool = True
    """Continue from the checkpoint in the folder, if there is one."""


@dataclass(frozen=True, kw_only=True)
class FitArguments(TrainArguments):
    """Fit a network to collected data."""

    static: str | None = None
    data: Path | None = None
    """Folder of the collected shards; runs/data/TASK-STATIC when not given."""


@dataclass(frozen=True, kw_only=True)
class PolicyArguments(TrainArguments):
    """Train a policy by trial."""

    steps: int | None = None
    """Rounds of episodes and updates; the recipe's own when not given."""
    num_envs: int | None = None
    """Episodes that run side by side; the recipe's own when not given."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores; does not change the result."""
    workers: int = 0
    """Ray workers that run the episodes, 0 to run them in this process."""
    algorithm: str | None = None
    training: Any = None


@dataclass(frozen=True, kw_only=True)
class BenchArguments(Arguments):
    """Measure speed on this machine: of a plan, of the simulation, or of kinematics."""

    benchmark: ClassVar[str]

    out: Path | None = None
    """JSON file for the figures, written with each: a run that is killed leaves those it has; another begins anew."""


@dataclass(frozen=True, kw_only=True)
class ReplanArguments(BenchArguments):
    """Time planners: their plans, the parts of these, and their steps."""

    benchmark = "replan"

    planner: tuple[str, ...] = ()
    static: str = ""
    weights: Path | None = None
    """Folder of the networks of the task's planners, as train leaves it; those that ship when not given."""
    batches: tuple[int, ...] = (1, 1024)
    """Rows that plan at once."""
    seconds: float = 0.2
    """Time spent on each figure [s]."""
    threads: int = 1
    """Threads of torch, 0 for all cores."""
    device: str = "cpu"
    """Where the planners run: cpu, cuda, cuda:1, …"""
    compiled: bool = False
    """Measure compiled plans and networks too: each takes up to a minute or two to compile."""


@dataclass(frozen=True, kw_only=True)
class EnvArguments(BenchArguments):
    """Time the simulation: how much of MuJoCo's rate is left with the environment and a planner in the loop."""

    benchmark = "env"


@dataclass(frozen=True, kw_only=True)
class KinematicsArguments(BenchArguments):
    """Time kinematics beside other libraries'; a plot is put beside the figures."""

    benchmark = "kinematics"

    compiled: bool = True
    """Measure compiled forms too: they take minutes to compile."""


@dataclass(frozen=True, kw_only=True)
class SeriesArguments(BenchArguments):
    """Run every benchmark, into one file with versions, machine and commit."""

    benchmark = "all"

    seconds: float = 0.2
    """Time spent on each figure of kinematics and re-plans [s]."""
    compiled: bool = False
    """Measure compiled forms too: they take minutes to compile."""
