"""What each command takes. Light on purpose: nothing heavy is imported until an argument is checked."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

from torchdyn_plan.errors import InputError, UsageError

PLANNERS = ("pursuit", "wait", "corner", "oracle", "exact", "meet")
"""Names of the planners for a moving target."""

STATICS = ("ik", "rl")
"""Names of Trapper's static planners."""


class Task(NamedTuple):
    """What a task has to choose from; the first static planner is the one taken when none is named."""

    planners: tuple[str, ...]
    statics: tuple[str, ...]
    fastest: float
    """Greatest velocity of the target: m/s in Trapper, metres per control step in Reach."""
    rivals: tuple[str, ...] = ()
    """Planners that run only when they are named."""


TASKS = {
    "trapper": Task(PLANNERS, STATICS, 20.0),
    "reach": Task(("pursuit", "corner", "oracle", "exact"), ("proportional", "rl"), 0.2, ("dher",)),
}
"""Tasks by name: Trapper, a UR5 that drops a box over a ball, and Reach, a Fetch arm that reaches a moving goal."""

MOTIONS = ("straight", "circle", "random")
"""How goals of Reach move."""

DHER_READING: dict[str, Any] = {"motion": "straight", "goal_range": 0.1, "threshold": 0.01}
"""How DHER's authors have the goals of Reach move and start, and when a gripper is at one."""

CONTROL_STEP_MS = 4
"""Length of a control step [ms]."""

SPLITS = ("test", "dev")
"""Series of episodes to evaluate on: tuning sees ``dev`` only."""

BENCHMARKS = {
    "replan": "torchdyn_plan.evaluation.bench_replan",
    "env": "torchdyn_plan.evaluation.bench_env",
    "kinematics": "torchdyn_plan.evaluation.bench_kinematics",
}
"""Name of each benchmark, and the module whose ``bench()`` returns its rows and whose ``plot``, if any, draws them."""


@contextmanager
def _as_usage_error() -> Iterator[None]:
    """Let a failed check surface as the error of a command, which no parser takes for a value it cannot convert."""
    try:
        yield
    except InputError as error:
        raise UsageError(str(error)) from error


def _check_names(task: str, planners: tuple[str, ...], static: str, split: str) -> None:
    from torchdyn_plan.checks import check_choice

    for planner in planners:
        check_choice("planner", planner, TASKS[task].planners + TASKS[task].rivals)
    if len(set(planners)) < len(planners):
        raise InputError(f"planners must be named once each, got {' '.join(planners)}")
    check_choice("static planner", static, TASKS[task].statics)
    check_choice("split", split, SPLITS)


def _check_counts(**counts: tuple[int | None, int]) -> None:
    """Check integers given as ``name=(value, minimum)``; None stands for a default."""
    from torchdyn_plan.checks import check_number

    for name, (value, minimum) in counts.items():
        if value is not None:
            check_number(name, value, minimum=minimum, integer=True)


def _check_target(given: "EpisodeArguments") -> None:
    from torchdyn_plan.checks import check_choice, check_number

    check_number("velocity", given.velocity, minimum=0.0, maximum=TASKS[given.task].fastest)
    check_number("friction", given.friction, minimum=0.0)
    check_choice("motion", given.motion, MOTIONS)
    check_number("goal_range", given.goal_range, minimum=0.0)
    check_number("threshold", given.threshold, minimum=1e-6)
    if given.task != "trapper" and given.friction:
        raise InputError(f"friction is the ball's in Trapper: {given.task} has none, got {given.friction!r}")
    for name, default in DHER_READING.items():
        value = getattr(given, name)
        if given.task != "reach" and value != default:
            raise InputError(f"{name} is the goal's in reach: {given.task} has none, got {value!r}")


def _known_task(name: str) -> Task:
    from torchdyn_plan.checks import check_choice

    check_choice("task", name, TASKS)
    return TASKS[name]


def _check_latency(latency_ms: float) -> None:
    from torchdyn_plan.checks import check_number

    check_number("latency_ms", latency_ms, minimum=0.0)
    if latency_ms % CONTROL_STEP_MS:
        raise InputError(f"latency_ms must be whole control steps of {CONTROL_STEP_MS} ms, got {latency_ms:g}")


@dataclass(frozen=True, kw_only=True)
class EpisodeArguments:
    """Which episodes are run, and by which planners."""

    task: str = "trapper"
    """What the arm has to do: trapper, or reach, whose velocity alone varies in a sweep."""
    planners: tuple[str, ...] = PLANNERS
    """Planners for the moving target: pursuit, wait, corner, oracle, exact, meet; Reach has neither wait nor meet, but
    the rival dher."""
    static: str = ""
    """Static planner that drives the arm: ik or rl (a learned policy) in Trapper, proportional or rl in Reach. The
    first of the task's when not given."""
    velocity: float = 3.0
    """Velocity of the ball at the start [m/s]; in Reach of the goal [m per control step], 0.001 to 0.051 in the paper.
    """
    friction: float = 0.0
    """Friction loss of the ball [N]."""
    motion: str = DHER_READING["motion"]
    """How the goal of Reach moves: straight, circle, or random (straight in any direction)."""
    goal_range: float = DHER_READING["goal_range"]
    """Goals of Reach on lines start within this of the gripper along either axis [m]: 0.1 in DHER, 0.15 in FetchReach.
    """
    threshold: float = DHER_READING["threshold"]
    """A gripper within this of its goal in Reach is there [m]: 0.01 in DHER, 0.05 in FetchReach."""
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


@dataclass(frozen=True, kw_only=True)
class EvaluateArguments(EpisodeArguments):
    """Run episodes at one velocity and friction with each planner; print a table and write the results."""

    latency_ms: float = 0.0
    """Time by which every plan comes late, whole control steps of 4 ms; pursuit plans nothing and has none."""
    compensate: bool = True
    """Tell the planners of that time, so that they plan for the moment when the plan is there."""
    out: Path | None = None
    """Folder for results.json, episodes.json and the plot; nothing is written without it."""

    def __post_init__(self) -> None:
        with _as_usage_error():
            task = _known_task(self.task)
            # Frozen, but for what is left to the task.
            object.__setattr__(self, "static", self.static or task.statics[0])
            if self.planners == PLANNERS:
                object.__setattr__(self, "planners", task.planners)
            if not self.planners:
                raise InputError(f"planners must name at least one of {', '.join(task.planners)}")
            _check_names(self.task, self.planners, self.static, self.split)
            _check_target(self)
            _check_latency(self.latency_ms)
            if self.latency_ms and self.task != "trapper":
                raise InputError(f"latency is injected in trapper only, got latency_ms {self.latency_ms:g}")
            _check_counts(
                episodes=(self.episodes, 1), seed=(self.seed, 0), num_envs=(self.num_envs, 1), threads=(self.threads, 0)
            )

    @property
    def latency_steps(self) -> int:
        """`latency_ms` in control steps."""
        return round(self.latency_ms / CONTROL_STEP_MS)


@dataclass(frozen=True, kw_only=True)
class SweepArguments(EpisodeArguments):
    """Evaluate along a range of velocities or frictions, as the paper's Figure 4; a killed sweep continues."""

    over: Literal["velocity", "friction"]
    """What varies."""
    out: Path
    """Folder of the sweep: its points, results.json and the plot. One that holds points already is continued."""
    values: tuple[float, ...] = ()
    """Velocities [m/s] or friction losses [N]; the paper's when none are given."""
    repeats: int = 10
    """Series of episodes for each value, with seeds upwards from the first."""

    def __post_init__(self) -> None:
        with _as_usage_error():
            if self.over not in ("velocity", "friction"):
                raise InputError(f"over must be velocity or friction, got {self.over!r}")
            if len(set(self.values)) < len(self.values):
                raise InputError(f"values must differ, got {' '.join(map(str, self.values))}")
            _check_counts(repeats=(self.repeats, 1))
            if self.task == "reach" and self.over != "velocity":
                raise InputError(f"over must be velocity in reach, got {self.over!r}")
        for value in (*self.values, None):
            point = self.point(value, 0)
            object.__setattr__(self, "static", point.static)
            object.__setattr__(self, "planners", point.planners)

    def point(self, value: float | None, repeat: int) -> EvaluateArguments:
        """The evaluation at one value (None: the fixed ones) and repeat, with nothing written."""
        shared: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(EpisodeArguments)}
        if self.task == "reach":
            shared["velocity"] = 0.0
        if value is not None:
            shared[self.over] = value
        shared["seed"] = self.seed + repeat
        return EvaluateArguments(**shared)


@dataclass(frozen=True, kw_only=True)
class CollectArguments:
    """Gather training data: paths of the rolling ball, or arrival times of a static planner."""

    what: Literal["paths", "arrivals"]
    """Paths of the target for the forecaster, or arrivals of the arm for the arrival-time network."""
    task: str = "trapper"
    """What the arm has to do: trapper or reach."""
    out: Path = Path("runs/data")
    """Folder for the shards of data."""
    static: str = ""
    """Static planner whose arrivals are measured: ik or rl in Trapper, proportional or rl in Reach."""
    weights: Path | None = None
    """Policy of the static planner rl: a file, or a folder of its training; the one that ships when not given."""
    episodes: int = 20000
    """Number of balls rolled, or of sequences of runs of the static planner."""
    seed: int = 0
    """Which series of episodes."""
    num_envs: int = 256
    """Episodes that run side by side."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores."""

    def __post_init__(self) -> None:
        from torchdyn_plan.checks import check_choice

        with _as_usage_error():
            task = _known_task(self.task)
            object.__setattr__(self, "static", self.static or task.statics[0])
            check_choice("static planner", self.static, task.statics)
            if self.weights is not None and (self.static, self.what) != ("rl", "arrivals"):
                raise InputError(f"weights are of a policy: they go with arrivals of --static rl, got {self.static}")
            _check_counts(
                episodes=(self.episodes, 1), seed=(self.seed, 0), num_envs=(self.num_envs, 1), threads=(self.threads, 0)
            )


@dataclass(frozen=True, kw_only=True)
class TrainArguments:
    """Train a network, on collected data or by trial; a killed run continues where its folder stands."""

    what: Literal["forecaster", "eta", "spread", "policy", "dher"]
    """Which network: forecaster (paths of the target), eta (arrival times of the arm), spread (how far the forecaster
    that ships is off, on paths of the ball), policy (by DDPG and HER) or, in Reach, dher (a policy for goals that move,
    by DDPG and DHER)."""
    task: str = "trapper"
    """What the arm has to do: trapper or reach."""
    data: Path = Path("runs/data")
    """Folder of the collected shards; a policy needs none."""
    out: Path = Path("runs/training")
    """Folder for checkpoints, the curve and the weights, one for each network."""
    steps: int | None = None
    """Optimiser steps (of a policy: rounds); the recipe's own when not given."""
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
    velocity: float = 0.011
    """Of dher: velocity of the goals [m per control step]."""
    num_envs: int | None = None
    """Of a policy: episodes that run side by side; the recipe's own when not given."""
    period: int = 5
    """Of a policy: control steps for which an action holds while it learns."""
    threads: int = 0
    """Of a policy: threads of the simulation, 0 for all cores; does not change the result."""
    workers: int = 0
    """Of a policy: Ray workers that run the episodes, 0 to run them in this process."""

    def __post_init__(self) -> None:
        from torchdyn_plan.checks import check_number

        with _as_usage_error():
            _known_task(self.task)
            if self.what == "dher" and self.task != "reach":
                raise InputError(f"dher is trained in reach alone: give --task reach, got {self.task!r}")
            check_number("velocity", self.velocity, minimum=0.0, maximum=TASKS["reach"].fastest)
            _check_counts(
                steps=(self.steps, 1), batch=(self.batch, 1), seed=(self.seed, 0), num_envs=(self.num_envs, 1),
                period=(self.period, 1), threads=(self.threads, 0), workers=(self.workers, 0),
            )  # fmt: skip
            if self.lr is not None:
                check_number("lr", self.lr, minimum=1e-9)

    def settings(self) -> dict[str, int | float | str | bool]:
        """Keyword arguments of the fit: those that were given, and the rest that always are."""
        given = {"steps": self.steps, "batch": self.batch, "lr": self.lr}
        always = {"seed": self.seed, "device": self.device, "resume": self.resume}
        return always | {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class BenchArguments:
    """Measure speed on this machine."""

    name: str
    """What to measure: replan (latency of a re-plan), env (rate of the simulation) or kinematics (beside others')."""
    out: Path | None = None
    """JSON file for the figures; a plot, where there is one, is put beside it."""
    compiled: bool = True
    """Measure compiled forms too, where there are any: they take minutes to compile."""

    def __post_init__(self) -> None:
        from torchdyn_plan.checks import check_choice

        with _as_usage_error():
            check_choice("benchmark", self.name, BENCHMARKS)
