"""Where corner search loses balls: each learned part is replaced by the truth in turn.

Forecast: the network's, or the ball's recorded path. Arrival: the network's, or measured by driving copies of the
arm. Losses that remain with both true are caused by the search and the static planner's timing.

    python benchmarks/diagnose.py --out benchmarks/results/diagnose.json
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import tyro
from study import Episodes, Row, Setting, Study, each, measuring, success_of
from tqdm import trange

from torchdyn_plan import keys
from torchdyn_plan.evaluation.episodes import EpisodeLog
from torchdyn_plan.evaluation.results import EpisodeOutcomes, failure_shares
from torchdyn_plan.planners import CornerSearch, DynamicPlanner, RecordedFuture
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.measured import MeasuredArrival

FORECASTS = ("network", "truth")
ARRIVALS = ("network", "network, expectation", "measured")


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Evaluate corner search with true parts; all episodes run side by side, so that they re-plan together."""

    velocities: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """[m/s]"""
    episodes: int = 128
    split: str = "test"
    arrivals: tuple[str, ...] = ARRIVALS
    """Which arrivals; measured ones take minutes."""


def planner_of(setting: Setting, forecast: str, arrival: str) -> DynamicPlanner:
    """Corner search with learned and true parts."""
    learned = setting.planner("corner", chunk=setting.task.rows_at_once[1])
    parts: dict[str, Any] = {}
    if forecast == "truth":
        parts["forecaster"] = RecordedFuture()
    if arrival == "measured":
        parts["eta"] = MeasuredArrival(setting.task.static_planner())
    if arrival == "network, expectation":
        parts["search"] = CornerSearch(estimator="expectation")
    return learned.with_parts(**parts)


def play_together(planner: Any, setting: Setting) -> EpisodeOutcomes:
    """Outcomes of all episodes side by side, none put back, so that all re-plan and are measured at the same steps."""
    task, arguments, truth = setting.task, setting.arguments, setting.truth
    count = arguments.episodes
    env = task.make_env(
        setting.settings, num_envs=count, seed=arguments.seed, split=arguments.split, num_threads=arguments.threads
    )
    log, tensordict = EpisodeLog.empty(count, task, env), env.reset()
    for _ in trange(env.max_steps, leave=False, disable=None):
        stepped = env.step(planner(tensordict.set(keys.TARGET_FUTURE, truth.future)))
        log.add(stepped)
        tensordict = env.step_mdp(stepped)
    assert task.judge
    verdict = task.judge(setting.settings, log, truth)
    return EpisodeOutcomes(
        success=log.success,
        steps=log.steps,
        replans=log.replans,
        solvable=truth.solvable,
        flags=log.flags,
        cause=verdict.cause,
        causes=task.causes,
        seconds=0.0,
    )


def row_of(setting: Setting, forecast: str, arrival: str) -> Row:
    """Success with these parts, and the paper's with the same forecast."""
    outcomes = play_together(planner_of(setting, forecast, arrival), setting)
    task = setting.task
    assert task.paper
    known = "oracle" if forecast == "truth" else "corner"
    paper = task.paper().rate(known, setting.static, setting.settings, solvable=True)
    success = outcomes.success.double().mean().item()
    found = {"success": success, "failures": failure_shares(outcomes), "paper_success_solvable": paper}
    return success_of(outcomes) | found


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    cases = [(forecast, arrival) for forecast in FORECASTS for arrival in arguments.arrivals]
    with measuring():
        for velocity in arguments.velocities:
            setting = Setting(task, arguments, velocity=velocity)
            for forecast, arrival in each(cases, f"{velocity:g} m/s"):
                about = {"forecast": forecast, "arrival": arrival, **setting.about}
                study.row(about, partial(row_of, setting, forecast, arrival))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
