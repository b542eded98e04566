"""Arguments of each command; `torchdyn_plan.cli.forms` adds the choices of a task.

Only types are fixed here: values are checked by the functions that receive them, so that Python and the command line
give the same errors.
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
    """Arguments of every command; task and scene are read from the command line before anything else."""

    task: str = DEFAULT


@dataclass(frozen=True, kw_only=True)
class TrackArguments:
    """Parameters of the track; the track's own defaults where not given. Not every track has all of them."""

    noise: float | None = None
    """Standard deviation of a measurement's error along each axis [m]; the sensor's when not given."""
    speed: float | None = None
    """Standard deviation of the initial speed along each axis [m/s]."""
    max_speed: float | None = None
    """No target moves faster [m/s]."""
    gate: float | None = None
    """Largest deviation of a measurement from its prediction that is accepted [standard deviations]."""
    rebound: float | None = None
    """Share of the speed that is assumed to remain after a bounce."""
    patience: float | None = None
    """Time without a measurement after which a track is lost [s]."""
    least: int | None = None
    """Measurements that a track needs before it is used."""
    oldest: float | None = None
    """Largest age of a measurement relative to the newest one [s]."""
    window: float | None = None
    """Of least_squares: time over which a measurement's weight falls to 1/e [s]."""
    agility: float | None = None
    """Of kalman: after t seconds the velocity may have changed by this times the root of t [m/s² per √Hz]; of ballistic
    the acceleration [m/s³ per √Hz]."""
    accelerates: bool | None = None
    """Of kalman: whether the acceleration is constant, and not the velocity."""
    acceleration: float | None = None
    """Of kalman with accelerates: standard deviation of the initial acceleration [m/s²]; of ballistic that of what
    accelerates the target beside gravity."""
    gravity: tuple[float, ...] | None = None
    """Of ballistic: acceleration of a target that falls, a number for each axis [m/s²]."""


@dataclass(frozen=True, kw_only=True)
class PlannerArguments(Arguments):
    """Who plays, and what they see."""

    planners: tuple[str, ...] = ()
    static: str = ""
    settings: Any = None
    weights: Path | None = None
    """Folder of the planners' networks, as train leaves it; those that ship when not given."""
    seed: int = 0
    """Series of episodes; in a sweep the first one."""
    split: str = "test"
    """Which family of series: test, or dev for tuning."""
    latency_ms: float = 0.0
    """Delay of every plan, a multiple of the control step; no effect on planners that make no plans."""
    sensor: Any = None
    track: str = "none"
    track_settings: Any = None
    compensate: bool = True
    """Let planners plan for the moment at which the delayed plan is available."""


@dataclass(frozen=True, kw_only=True)
class EpisodeArguments(PlannerArguments):
    """Which episodes are run, and by which planners."""

    episodes: int = 100
    """Episodes for each planner, always numbers 0 to N-1; in a sweep for each value and repeat."""
    num_envs: int = 64
    """Episodes that run side by side; does not change the results."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores; does not change the results."""
    overwrite: bool = False
    """Replace results of another configuration in the folder; without it they are kept, and the command stops."""


@dataclass(frozen=True, kw_only=True)
class ViewArguments(PlannerArguments):
    """Watch a task in a browser, on this machine alone: an episode step by step, and two planners side by side."""

    out: ClassVar[None] = None

    episode: int = 0
    """Number of the episode that is shown first."""
    port: int = 8080
    """Port of the page, http://127.0.0.1:PORT; the next free one if it is taken."""


@dataclass(frozen=True, kw_only=True)
class FilmArguments:
    """How a film or a strip is drawn."""

    width: int = 400
    """Width of each planner's picture [pixels]."""
    height: int = 300
    """Height of the same [pixels]."""
    fps: float = 25.0
    """Pictures a second of a film."""
    speed: float = 0.5
    """Seconds of the episode in a second of the film."""
    hold: float = 1.0
    """Time for which a film's last picture stays [s]."""
    strip: int = 8
    """Pictures of a strip."""
    quality: int = 60
    """Of a WebP, 0 to 100."""


@dataclass(frozen=True, kw_only=True)
class RecordArguments(PlannerArguments):
    """Draw an episode without a screen, its planners side by side: a film, or a strip of pictures."""

    out: Path
    """File of the film, .webp, .gif or .mp4, or of the strip, .png."""
    episode: int = 0
    """Number of the episode."""
    film: Any = None
    layers: tuple[str, ...] = ()


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
    """Folder of the sweep: its points, results.json and the plot. Existing points are not run again."""
    values: tuple[float, ...] = ()
    """Values of the setting; the paper's when none are given, or the task's."""
    repeats: int = 10
    """Series of episodes for each value, with consecutive seeds."""
    engine: str = "here"
    workers: int | None = None
    """Ray workers, of one thread each; as many as the cluster has processors when not given."""


@dataclass(frozen=True, kw_only=True)
class ReportArguments:
    """Draw the figures of the papers of all tasks, or of --task NAME, with our results in them, as SVG and PNG."""

    out: Path
    """Folder for the figures, and for report.json with their points."""
    results: Path | None = None
    """Folder with the results of sweeps, at any depth; benchmarks/results of the checkout when not given."""


@dataclass(frozen=True, kw_only=True)
class CollectArguments(Arguments):
    """Collect training data: paths of undisturbed targets, arrivals of a static planner, or attempts at a capture."""

    what: str
    static: str = ""
    out: Path | None = None
    """Folder for the shards of data; runs/data/TASK-STATIC when not given."""
    weights: Path | None = None
    """Weights of a static planner that is a policy: file, or folder of its training; the shipped ones by default."""
    planner: str = ""
    """Your own static planner whose arrivals are measured, in place of --static: package.module:NAME, or a function
    there that makes one."""
    tracks: Path | None = None
    episodes: int = 20000
    """Number of targets, of sequences of runs of the static planner, or of episodes with attempts."""
    seed: int = 0
    """Which series of episodes."""
    num_envs: int = 256
    """Episodes that run side by side."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores."""


@dataclass(frozen=True, kw_only=True)
class TrainArguments(Arguments):
    """Train a network on collected data, or a policy; a killed run continues from its folder."""

    out: Path | None = None
    """Folder for checkpoints, curve and weights, with a folder for each network in it; runs/training/TASK-STATIC
    when not given, for policies runs/training/TASK."""
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
    """Train a policy by reinforcement learning."""

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
    """JSON file for the figures, written after each one; a killed run leaves what it has, the next one starts again."""


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
    """Time the simulation: the share of MuJoCo's own rate that remains with environment and planner."""

    benchmark = "env"


@dataclass(frozen=True, kw_only=True)
class KinematicsArguments(BenchArguments):
    """Time kinematics and other libraries' for comparison; a plot is written beside the figures."""

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
