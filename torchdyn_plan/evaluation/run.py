"""Episodes with a planner in the loop: what `torchdyn-plan evaluate` runs and prints."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.episodes import draw_starts
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.trapper import MAX_STEPS, TrapperEnv
from torchdyn_plan.envs.trapping import is_touched
from torchdyn_plan.evaluation.latency import delay_plans
from torchdyn_plan.evaluation.plots import plot_results
from torchdyn_plan.evaluation.report import format_table
from torchdyn_plan.evaluation.results import EpisodeOutcomes, summarize, write_results
from torchdyn_plan.evaluation.solvability import arrival_map, is_solvable, record_path
from torchdyn_plan.planners import (
    STATIC_PLANNERS,
    DynamicPlanner,
    ExactSearch,
    IKPlanner,
    MeetingPlanner,
    OracleTrajectory,
    TargetPursuit,
)
from torchdyn_plan.planners.protocol import GoalSearch

Planner = Callable[[TensorDictBase], TensorDictBase]

CHUNK = 32
"""Rows that a network sees at once, whatever the number of environments: few, as few plan at the same step."""
IK_CHUNK = 64
"""Rows that the inverse kinematics sees at once, whatever the number of environments."""
HORIZON = 300
"""Control steps that the recorded truth goes on after the end of an episode."""

PLANNERS: dict[str, Callable[[str], Planner]] = {
    "pursuit": lambda static: TargetPursuit(static_planner(static)),
    "corner": lambda static: _pretrained(DynamicPlanner, static),
    "oracle": lambda static: _pretrained(OracleTrajectory, static),
    "exact": lambda static: _pretrained(DynamicPlanner, static, search=ExactSearch()),
    "meet": lambda static: _pretrained(MeetingPlanner, static),
}
"""The planners for a moving target by name, on the static planner of a given name."""


def static_planner(name: str) -> IKPlanner:
    """The static planner of that name, whose results do not depend on the number of environments."""
    return STATIC_PLANNERS[name](chunk=IK_CHUNK)


def _pretrained(kind: type[DynamicPlanner], static: str, *, search: GoalSearch | None = None) -> DynamicPlanner:
    planner = kind.from_pretrained(f"trapper-{static}", chunk=CHUNK)
    planner.static, planner.search = static_planner(static), search or planner.search
    return planner


def evaluate(arguments: EvaluateArguments) -> None:
    """Run the episodes, print one table, and write results and a plot where ``arguments.out`` says."""
    outcomes = run_points(arguments)
    setting = {"static": arguments.static, "velocity": arguments.velocity, "friction": arguments.friction}
    rows = [summarize(outcome, planner=name, **setting) for name, outcome in outcomes.items()]
    print(format_table(rows))
    if arguments.out is not None:
        config = dataclasses.asdict(arguments) | {"out": str(arguments.out), "scene": TrapperScene().digest()}
        write_results(arguments.out, config, rows, outcomes)
        plot_results(rows, arguments.out / "results.png")
        print(f"\nwritten: {', '.join(str(path) for path in sorted(Path(arguments.out).iterdir()))}")


def run_points(arguments: EvaluateArguments) -> dict[str, EpisodeOutcomes]:
    """Outcomes of the same episodes for each planner that ``arguments`` name."""
    with one_thread():
        planners = {name: PLANNERS[name](arguments.static) for name in arguments.planners}
        for planner in planners.values():
            delay_plans(planner, arguments.latency_steps, told=arguments.compensate)
        future, solvable = record_truth(arguments)
        return {name: run_episodes(planner, arguments, future, solvable, name) for name, planner in planners.items()}


def record_truth(arguments: EvaluateArguments) -> tuple[Tensor, Tensor]:
    """Recorded future ``(E, T, 3)`` of every episode's ball, and which episodes are solvable ``(E,)``."""
    scene, threads = TrapperScene(), arguments.threads
    arrivals = arrival_map(arguments.static, static_planner(arguments.static), scene, num_threads=threads)
    place, velocity = draw_starts(
        scene, torch.arange(arguments.episodes), velocity=arguments.velocity, split=arguments.split, seed=arguments.seed
    )
    path = record_path(
        scene, place, velocity, steps=MAX_STEPS + HORIZON, friction=arguments.friction, num_threads=threads
    )  # fmt: skip
    return path, is_solvable(arrivals, scene, path[:, : MAX_STEPS + 1])


def run_episodes(
    planner: Planner, arguments: EvaluateArguments, future: Tensor, solvable: Tensor, name: str
) -> EpisodeOutcomes:
    """Outcomes of episodes 0 … E-1 under ``planner``; an environment takes the next episode when its own ends.

    Args:
        planner: any planner for a moving target.
        arguments: velocity, friction, seed and how many side by side.
        future: ``(E, T, 3)`` recorded truth, shown to planners that read ``target_future``.
        solvable: ``(E,)`` bool, passed on.
        name: shown beside the progress bar.
    """
    from tqdm import tqdm

    count = arguments.episodes
    env = TrapperEnv(
        min(arguments.num_envs, count), velocity=arguments.velocity, friction=arguments.friction, seed=arguments.seed,
        split=arguments.split, num_threads=arguments.threads,
    )  # fmt: skip
    log = EpisodeLog.empty(count)
    started = time.perf_counter()
    with torch.no_grad(), tqdm(total=count, desc=name, unit="episode", leave=False) as bar:
        for ended in play(planner, env, log, future):
            bar.update(ended)
            if bar.n >= count:
                break
    return EpisodeOutcomes(
        trapped=log.trapped, steps=log.steps, replans=log.replans, touched=log.touched, pocketed=log.pocketed,
        solvable=solvable, seconds=time.perf_counter() - started,
    )  # fmt: skip


def play(planner: Planner, env: TrapperEnv, log: EpisodeLog, future: Tensor | None = None) -> Iterator[int]:
    """Step all environments once for each value taken, which is the number of ``log``'s episodes that the step ended.

    ``future`` (E, T, 3) is the recorded truth for planners that read ``target_future``.
    """
    if keys.TARGET_FUTURE not in getattr(planner, "in_keys", ()):
        future = None
    tensordict = env.reset()
    while True:
        if future is not None:
            tensordict[keys.TARGET_FUTURE] = future[tensordict[keys.EPISODE].clamp(max=len(future) - 1)]
        stepped, tensordict = env.step_and_maybe_reset(planner(tensordict))
        yield log.add(env.scene, stepped)


@dataclasses.dataclass
class EpisodeLog:
    """What has happened in each episode so far; every tensor is ``(E,)``."""

    done: Tensor
    trapped: Tensor
    touched: Tensor
    pocketed: Tensor
    steps: Tensor
    replans: Tensor

    @classmethod
    def empty(cls, count: int) -> EpisodeLog:
        """The log of ``count`` episodes to come."""
        flags = [torch.zeros(count, dtype=torch.bool) for _ in range(4)]
        return cls(*flags, steps=torch.full((count,), -1), replans=torch.zeros(count, dtype=torch.int64))

    def add(self, scene: TrapperScene, stepped: TensorDict | TensorDictBase) -> int:
        """Take in one step of all environments; returns how many episodes it ended. What comes later does not count."""
        after: TensorDictBase = stepped.get("next")
        episode = after[keys.EPISODE]
        touched = is_touched(scene, after[keys.TOOL_POS], after[keys.TARGET_POS])
        done = after["done"].squeeze(-1)
        ours = episode < len(self.done)
        ours[ours.clone()] = ~self.done[episode[ours]]
        hit = episode[touched & ours]
        self.touched[hit] = True
        ended = done & ours
        if not ended.any():
            return 0
        rows = episode[ended]
        trapped = after[keys.TRAPPED].squeeze(-1)[ended]
        self.done[rows], self.trapped[rows] = True, trapped
        self.pocketed[rows] = after[keys.POCKETED].squeeze(-1)[ended]
        self.steps[rows] = torch.where(trapped, after[keys.STEP_COUNT][ended], -1)
        replans = stepped.get((keys.PLAN, "replans"), None)
        self.replans[rows] = 0 if replans is None else replans[ended]
        return len(rows)


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: networks this small are fastest on one thread, which leaves the cores to the simulation."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
