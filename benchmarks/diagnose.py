"""Where corner search loses balls: each learned part in turn replaced by the truth.

Forecast: the network's, or the ball's recorded path. Arrival: the network's, or measured by driving copies of the
arm. What is still lost with both true is lost by the search and by the static planner's timing.

    python benchmarks/diagnose.py --out benchmarks/results/diagnose.json
"""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor
from tqdm import trange

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.trapper import MAX_STEPS, TrapperEnv
from torchdyn_plan.evaluation.measured import MeasuredArrival
from torchdyn_plan.evaluation.paper import paper_rate
from torchdyn_plan.evaluation.planners import STATIC_CHUNK
from torchdyn_plan.evaluation.results import EpisodeOutcomes, summarize
from torchdyn_plan.evaluation.run import EpisodeLog, record_truth
from torchdyn_plan.files import write_json
from torchdyn_plan.planners import CornerSearch, DynamicPlanner, IKPlanner
from torchdyn_plan.planners.baselines import RecordedFuture
from torchdyn_plan.versions import library_versions, machine


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Evaluate corner search with true parts."""

    velocities: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """[m/s]"""
    episodes: int = 128
    """Episodes a point, all side by side, so that they re-plan together."""
    split: str = "test"
    """Series of episodes: test, or dev while tuning."""
    out: Path | None = None
    """JSON file for the figures."""


def planners() -> dict[str, DynamicPlanner]:
    """Every combination of learned and true parts."""
    learned = DynamicPlanner.from_pretrained("trapper-ik", chunk=STATIC_CHUNK)
    forecasts = {"network": learned.forecaster, "truth": RecordedFuture()}
    arrivals = {
        "network": (learned.eta, "mode"),
        "network, expectation": (learned.eta, "expectation"),
        "measured": (MeasuredArrival(IKPlanner()), "mode"),
    }
    return {
        f"{forecast} | {arrival}": DynamicPlanner(
            IKPlanner(chunk=STATIC_CHUNK),
            forecasts[forecast],
            eta,
            search=CornerSearch(reading=reading),
            chunk=STATIC_CHUNK,
        )
        for forecast in forecasts
        for arrival, (eta, reading) in arrivals.items()
    }


@torch.no_grad()
def run_together(
    planner: DynamicPlanner, setting: EvaluateArguments, future: Tensor, solvable: Tensor
) -> EpisodeOutcomes:
    """Outcomes of all episodes side by side, none put back, so that all re-plan and are measured at the same steps."""
    count, started = setting.episodes, time.perf_counter()
    env = TrapperEnv(count, velocity=setting.velocity, split=setting.split, seed=setting.seed)
    log, tensordict = EpisodeLog.empty(count), env.reset()
    for _ in trange(MAX_STEPS, leave=False):
        stepped = env.step(planner(tensordict.set(keys.TARGET_FUTURE, future)))
        log.add(stepped)
        tensordict = env.step_mdp(stepped)
    return log.outcomes(env.scene, future, solvable, time.perf_counter() - started)


def main(arguments: Arguments) -> None:
    """Run, print and write."""
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    print("velocity  forecast | arrival                success  of solvable  paper")
    for velocity in arguments.velocities:
        setting = EvaluateArguments(
            velocity=velocity, episodes=arguments.episodes, num_envs=arguments.episodes, split=arguments.split
        )  # fmt: skip
        future, solvable = record_truth(setting)
        for name, planner in planners().items():
            outcome = run_together(planner, setting, future, solvable)
            row = summarize(outcome, planner=name, static="ik", velocity=velocity, friction=0.0)
            paper = paper_rate("oracle" if "truth" in name else "corner", "ik", "velocity", velocity, solvable=True)
            print(
                f"{velocity:8g}  {name:30} {row.success:8.2f} {row.success_solvable or 0.0:12.2f} {paper or 0.0:6.2f}"
            )
            rows.append(asdict(row) | {"paper_success_solvable": paper})
    if arguments.out is not None:
        about = {"machine": machine(), "versions": library_versions(), "scene": TrapperScene().digest()}
        write_json(arguments.out, {"config": asdict(arguments) | {"out": str(arguments.out)}} | about | {"rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
