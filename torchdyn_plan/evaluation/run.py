"""Episodes with a planner in the loop: what `torchdyn-plan evaluate` runs and prints."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.episodes import draw_starts
from torchdyn_plan.envs.fetch import fetch_digest
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.trapper import MAX_STEPS, TrapperEnv
from torchdyn_plan.evaluation.evidence import Evidence, find_evidence
from torchdyn_plan.evaluation.latency import delay_plans
from torchdyn_plan.evaluation.planners import PLANNERS, Planner, static_planner
from torchdyn_plan.evaluation.play import one_thread, play_all
from torchdyn_plan.evaluation.plots import plot_results
from torchdyn_plan.evaluation.reach import run_reach
from torchdyn_plan.evaluation.report import format_table
from torchdyn_plan.evaluation.results import EpisodeOutcomes, summarize, write_results
from torchdyn_plan.evaluation.solvability import arrival_map, is_solvable, record_path
from torchdyn_plan.evaluation.traces import TraceLog

HORIZON = 300
"""Control steps that the recorded truth goes on after the end of an episode."""


def evaluate(arguments: EvaluateArguments) -> None:
    """Run the episodes, write results and a plot where ``arguments.out`` says, then print one table."""
    outcomes = run_points(arguments)
    setting = {name: getattr(arguments, name) for name in ("task", "static", "velocity", "friction", "motion")}
    rows = [summarize(outcome, planner=name, **setting) for name, outcome in outcomes.items()]
    if arguments.out is not None:
        scene = fetch_digest() if arguments.task == "reach" else TrapperScene().digest()
        config = dataclasses.asdict(arguments) | {"out": str(arguments.out), "scene": scene}
        write_results(arguments.out, config, rows, outcomes)
        plot_results(rows, arguments.out / "results.png")
    print(format_table(rows))
    if arguments.out is not None:
        print(f"\nwritten: {', '.join(str(path) for path in sorted(Path(arguments.out).iterdir()))}")


def run_points(arguments: EvaluateArguments) -> dict[str, EpisodeOutcomes]:
    """Outcomes of the same episodes for each planner that ``arguments`` name."""
    with one_thread():
        planners = {name: PLANNERS[name](arguments.static, arguments.task) for name in arguments.planners}
        if arguments.task == "reach":
            return run_reach(planners, arguments)
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
    env = TrapperEnv(
        min(arguments.num_envs, arguments.episodes), velocity=arguments.velocity, friction=arguments.friction,
        seed=arguments.seed, split=arguments.split, num_threads=arguments.threads,
    )  # fmt: skip
    log = EpisodeLog.empty(arguments.episodes)
    seconds = play_all(planner, env, log, future, name=name)
    return log.outcomes(env.scene, future, solvable, seconds)


@dataclasses.dataclass
class EpisodeLog:
    """What has happened in each episode so far; every tensor is ``(E,)``."""

    done: Tensor
    trapped: Tensor
    pocketed: Tensor
    steps: Tensor
    replans: Tensor
    traces: TraceLog
    """Step by step, all that was seen and planned."""
    order: list[Tensor]
    """Numbers of the episodes in the order in which they ended."""

    @classmethod
    def empty(cls, count: int) -> EpisodeLog:
        """The log of ``count`` episodes to come."""
        flags = [torch.zeros(count, dtype=torch.bool) for _ in range(3)]
        steps, replans = torch.full((count,), -1), torch.zeros(count, dtype=torch.int64)
        return cls(*flags, steps=steps, replans=replans, traces=TraceLog(MAX_STEPS), order=[])

    def add(self, stepped: TensorDict | TensorDictBase) -> int:
        """Take in one step of all environments; returns how many episodes it ended. What comes later does not count."""
        self.traces.add(stepped)
        after: TensorDictBase = stepped.get("next")
        done = after["done"].squeeze(-1)
        if not done.any():
            return 0
        episode = after[keys.EPISODE]
        ours = episode < len(self.done)
        ours[ours.clone()] = ~self.done[episode[ours]]
        ended = (done & ours).nonzero().squeeze(-1)
        if not len(ended):
            return 0
        rows, trapped = episode[ended], after[keys.TRAPPED].squeeze(-1)[ended]
        self.done[rows], self.trapped[rows] = True, trapped
        self.pocketed[rows] = after[keys.POCKETED].squeeze(-1)[ended]
        self.steps[rows] = torch.where(trapped, after[keys.STEP_COUNT][ended], -1)
        replans = stepped.get((keys.PLAN, "replans"), None)
        self.replans[rows] = 0 if replans is None else replans[ended]
        self.traces.end(stepped, ended)
        self.order.append(rows)
        return len(rows)

    def outcomes(self, scene: TrapperScene, future: Tensor, solvable: Tensor, seconds: float) -> EpisodeOutcomes:
        """How the episodes ended, and what their records say of it.

        Args:
            scene: sizes of box and ball.
            future: ``(E, T, 3)`` paths of the balls, had nothing touched them [m, world].
            solvable: ``(E,)`` bool, passed on.
            seconds: wall time of all episodes, passed on.
        """
        evidence, begin = Evidence.none(len(self.done)), 0
        order = torch.cat(self.order) if self.order else torch.empty(0, dtype=torch.int64)
        for trace in self.traces.traces():
            rows = order[begin : begin + len(trace.length)]
            for whole, part in zip(evidence, find_evidence(scene, trace, future[rows]), strict=True):
                whole[rows] = part
            begin += len(rows)
        return EpisodeOutcomes(
            trapped=self.trapped, steps=self.steps, replans=self.replans, touched=evidence.contact_step >= 0,
            pocketed=self.pocketed, solvable=solvable, seconds=seconds, evidence=evidence,
        )  # fmt: skip
