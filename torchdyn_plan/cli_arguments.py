"""What each command takes. Light on purpose: nothing heavy is imported until an argument is checked."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torchdyn_plan.errors import InputError, UsageError

PLANNERS = ("pursuit", "wait", "corner", "oracle", "exact", "meet")
"""Names of the planners for a moving target."""

STATICS = ("ik", "rl")
"""Names of the static planners."""

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


def _check_names(planners: tuple[str, ...], static: str, split: str) -> None:
    from torchdyn_plan.checks import check_choice

    if not planners:
        raise InputError(f"planners must name at least one of {', '.join(PLANNERS)}")
    for planner in planners:
        check_choice("planner", planner, PLANNERS)
    if len(set(planners)) < len(planners):
        raise InputError(f"planners must be named once each, got {' '.join(planners)}")
    check_choice("static planner", static, STATICS)
    check_choice("split", split, SPLITS)


def _check_counts(**counts: tuple[int | None, int]) -> None:
    """Check integers given as ``name=(value, minimum)``; None stands for a default."""
    from torchdyn_plan.checks import check_number

    for name, (value, minimum) in counts.items():
        if value is not None:
            check_number(name, value, minimum=minimum, integer=True)


def _check_ball(velocity: float, friction: float) -> None:
    from torchdyn_plan.checks import check_number

    check_number("velocity", velocity, minimum=0.0, maximum=20.0)
    check_number("friction", friction, minimum=0.0)


def _check_latency(latency_ms: float) -> None:
    from torchdyn_plan.checks import check_number

    check_number("latency_ms", latency_ms, minimum=0.0)
    if latency_ms % CONTROL_STEP_MS:
        raise InputError(f"latency_ms must be whole control steps of {CONTROL_STEP_MS} ms, got {latency_ms:g}")


@dataclass(frozen=True, kw_only=True)
class EvaluateArguments:
    """Run episodes at one velocity and friction with each planner; print a table and write the results."""

    planners: tuple[str, ...] = PLANNERS
    """Planners for the moving target: pursuit, wait, corner, oracle, exact, meet."""
    static: str = "ik"
    """Static planner that drives the arm: ik (inverse kinematics) or rl (a learned policy)."""
    velocity: float = 3.0
    """Velocity of the ball at the start [m/s]."""
    friction: float = 0.0
    """Friction loss of the ball [N]."""
    episodes: int = 100
    """Number of episodes for each planner, always episodes 0 to N-1."""
    seed: int = 0
    """Which series of episodes."""
    split: str = "test"
    """Which family of series: test, or dev for tuning."""
    num_envs: int = 64
    """Episodes that run side by side; does not change the results."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores; does not change the results."""
    latency_ms: float = 0.0
    """Time by which every plan comes late, whole control steps of 4 ms; pursuit plans nothing and has none."""
    compensate: bool = True
    """Tell the planners of that time, so that they plan for the moment when the plan is there."""
    out: Path | None = None
    """Folder for results.json, episodes.json and the plot; nothing is written without it."""

    def __post_init__(self) -> None:
        with _as_usage_error():
            _check_names(self.planners, self.static, self.split)
            _check_ball(self.velocity, self.friction)
            _check_latency(self.latency_ms)
            _check_counts(
                episodes=(self.episodes, 1), seed=(self.seed, 0), num_envs=(self.num_envs, 1), threads=(self.threads, 0)
            )

    @property
    def latency_steps(self) -> int:
        """`latency_ms` in control steps."""
        return round(self.latency_ms / CONTROL_STEP_MS)


@dataclass(frozen=True, kw_only=True)
class SweepArguments:
    """Evaluate along a range of velocities or frictions, as the paper's Figure 4; a killed sweep continues."""

    over: Literal["velocity", "friction"]
    """What varies."""
    out: Path
    """Folder of the sweep: its points, results.json and the plot. One that holds points already is continued."""
    values: tuple[float, ...] = ()
    """Velocities [m/s] or friction losses [N]; the paper's when none are given."""
    planners: tuple[str, ...] = PLANNERS
    """Planners for the moving target: pursuit, wait, corner, oracle, exact, meet."""
    static: str = "ik"
    """Static planner that drives the arm: ik (inverse kinematics) or rl (a learned policy)."""
    velocity: float = 3.0
    """Velocity of the ball when friction varies [m/s]."""
    friction: float = 0.0
    """Friction loss of the ball when velocity varies [N]."""
    episodes: int = 100
    """Number of episodes for each planner, value and repeat."""
    repeats: int = 10
    """Series of episodes for each value, with seeds upwards from the first."""
    seed: int = 0
    """Seed of the first series."""
    split: str = "test"
    """Which family of series: test, or dev for tuning."""
    num_envs: int = 64
    """Episodes that run side by side; does not change the results."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores; does not change the results."""

    def __post_init__(self) -> None:
        with _as_usage_error():
            if self.over not in ("velocity", "friction"):
                raise InputError(f"over must be velocity or friction, got {self.over!r}")
            if len(set(self.values)) < len(self.values):
                raise InputError(f"values must differ, got {' '.join(map(str, self.values))}")
            _check_counts(repeats=(self.repeats, 1))
        for value in (*self.values, None):
            self.point(value, 0)

    def point(self, value: float | None, repeat: int) -> EvaluateArguments:
        """The evaluation at one value (None: the fixed ones) and repeat, with nothing written."""
        return EvaluateArguments(
            planners=self.planners,
            static=self.static,
            velocity=value if value is not None and self.over == "velocity" else self.velocity,
            friction=value if value is not None and self.over == "friction" else self.friction,
            episodes=self.episodes,
            seed=self.seed + repeat,
            split=self.split,
            num_envs=self.num_envs,
            threads=self.threads,
        )


@dataclass(frozen=True, kw_only=True)
class CollectArguments:
    """Gather training data: paths of the rolling ball, or arrival times of a static planner."""

    what: Literal["paths", "arrivals"]
    """Paths of the ball for the forecaster, or arrivals of the arm for the arrival-time network."""
    out: Path = Path("runs/data")
    """Folder for the shards of data."""
    static: str = "ik"
    """Static planner whose arrivals are measured: ik or rl."""
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
            check_choice("static planner", self.static, STATICS)
            if self.weights is not None and (self.static, self.what) != ("rl", "arrivals"):
                raise InputError(f"weights are of a policy: they go with arrivals of --static rl, got {self.static}")
            _check_counts(
                episodes=(self.episodes, 1), seed=(self.seed, 0), num_envs=(self.num_envs, 1), threads=(self.threads, 0)
            )


@dataclass(frozen=True, kw_only=True)
class TrainArguments:
    """Train a network, on collected data or by trial; a killed run continues where its folder stands."""

    what: Literal["forecaster", "eta", "spread", "policy"]
    """Which network: forecaster (paths of the ball), eta (arrival times of the arm), spread (how far the forecaster
    that ships is off, on paths of the ball) or policy (by DDPG and HER)."""
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
