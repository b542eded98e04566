"""What latency costs: the same episodes with plans that come late, to planners that know it and to some that do not.

    python benchmarks/latency.py --split test --episodes 1000 --out benchmarks/results/latency/results.json

A killed run continues: rows that the file holds already are not run again.
"""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.intervals import paired_loss
from torchdyn_plan.evaluation.latency import delay_plans
from torchdyn_plan.evaluation.planners import PLANNERS
from torchdyn_plan.evaluation.play import one_thread
from torchdyn_plan.evaluation.results import summarize
from torchdyn_plan.evaluation.run import record_truth, run_episodes
from torchdyn_plan.files import write_json
from torchdyn_plan.versions import library_versions, machine


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Measure what latency costs."""

    out: Path
    """JSON file for the figures."""
    planners: tuple[str, ...] = ("meet",)
    """Planners for the moving target."""
    velocities: tuple[float, ...] = (3.0, 5.0)
    """[m/s]"""
    latencies: tuple[int, ...] = (0, 4, 20, 36)
    """[ms]; the first should be 0, which the others are compared with."""
    unaware: tuple[int, ...] = (20,)
    """Those that are run with a planner that is not told, too [ms]."""
    episodes: int = 300
    """Episodes a row."""
    split: str = "dev"
    """Series of episodes."""
    seed: int = 0
    """Which of them."""
    num_envs: int = 300
    """Episodes that run side by side; does not change the results."""
    threads: int = 1
    """Threads of the simulation, 0 for all cores."""


def run(arguments: Arguments, velocity: float) -> None:
    """Run the rows at one velocity that the file lacks, and write each when it is done."""
    setting = EvaluateArguments(
        velocity=velocity, episodes=arguments.episodes, split=arguments.split, seed=arguments.seed,
        num_envs=arguments.num_envs, threads=arguments.threads,
    )  # fmt: skip
    future, solvable = record_truth(setting)
    for name in arguments.planners:
        cases = [(latency, True) for latency in arguments.latencies]
        for latency, told in cases + [(latency, False) for latency in arguments.unaware]:
            about = {
                "planner": name, "velocity": velocity, "latency_ms": latency, "told": told,
                "split": arguments.split, "seed": arguments.seed, "episodes": arguments.episodes,
            }  # fmt: skip
            rows = _rows(arguments.out)
            if any(about.items() <= row.items() for row in rows):
                continue
            planner = delay_plans(PLANNERS[name]("ik"), latency // 4, told=told)
            outcomes = run_episodes(planner, setting, future, solvable, f"{name}, {latency} ms")
            row = summarize(outcomes, planner=name, static="ik", velocity=velocity, friction=0.0)
            kept = {
                "success_solvable": row.success_solvable, "success_solvable_ci": row.success_solvable_ci,
                "success": row.success, "replans": row.replans, "failures": row.failures,
            }  # fmt: skip
            lost = {
                "lost": (solvable & ~outcomes.trapped).nonzero().flatten().tolist(),
                "solvable": int(solvable.sum()),
            }
            result = about | kept | lost
            result |= _loss(result, [*rows, result])
            print({key: value for key, value in result.items() if key != "lost"}, flush=True)
            about_file = {"machine": machine(), "versions": library_versions(), "scene": TrapperScene().digest()}
            settings = dataclasses.asdict(arguments) | {"out": None}
            write_json(arguments.out, about_file | {"arguments": settings, "rows": [*rows, result]})


def _rows(file: Path) -> list[dict[str, Any]]:
    return json.loads(file.read_text())["rows"] if file.exists() else []


def _loss(row: dict[str, Any], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Share of the solvable episodes that this row loses beside the same ones without latency, paired."""
    same = ("planner", "velocity", "split", "seed", "episodes")
    for other in rows:
        if other["latency_ms"] == 0 and all(other[key] == row[key] for key in same):
            missed = sorted({*other["lost"], *row["lost"]})
            rest = torch.ones(row["solvable"] - len(missed), dtype=torch.bool)
            trapped = [torch.tensor([episode not in one["lost"] for episode in missed]) for one in (other, row)]
            loss = paired_loss(*(torch.cat([part.bool(), rest]) for part in trapped))
            return {"loss": loss.value, "loss_ci": [loss.low, loss.high]}
    return {"loss": None, "loss_ci": None}


if __name__ == "__main__":
    arguments = tyro.cli(Arguments)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with torch.no_grad(), one_thread():
        for velocity in arguments.velocities:
            run(arguments, velocity)
