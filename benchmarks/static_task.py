"""The static task: how many of the balls that lie still, and that the arm can cover at all, the static planner traps.

python benchmarks/static_task.py --out benchmarks/results/static_task.json
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro

from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.episodes import draw_starts
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.intervals import rate
from torchdyn_plan.evaluation.reachability import is_reachable
from torchdyn_plan.evaluation.run import run_points
from torchdyn_plan.files import write_json
from torchdyn_plan.versions import library_versions, machine


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Drop the box over balls that lie still."""

    static: str = "ik"
    """Static planner: ik or rl."""
    episodes: int = 1000
    """Number of balls, reachable or not."""
    split: str = "test"
    """Series of episodes: test, or dev while tuning."""
    seed: int = 0
    """Which series."""
    out: Path | None = None
    """JSON file for the figures."""


def main(arguments: Arguments) -> None:
    """Run, print and write."""
    torch.set_num_threads(1)
    scene = TrapperScene()
    place, _ = draw_starts(
        scene, torch.arange(arguments.episodes), velocity=0.0, split=arguments.split, seed=arguments.seed
    )  # fmt: skip
    reachable = is_reachable(scene, place)
    outcome = run_points(
        EvaluateArguments(
            planners=("pursuit",), static=arguments.static, velocity=0.0, episodes=arguments.episodes,
            split=arguments.split, seed=arguments.seed, num_envs=256,
        )
    )["pursuit"]  # fmt: skip
    share = rate(int((outcome.trapped & reachable).sum()), int(reachable.sum()))
    print(
        f"reachable {reachable.double().mean():.1%} of {arguments.episodes} balls; trapped of these {share.value:.2%}"
    )
    for x, y in place[reachable & ~outcome.trapped].tolist():
        print(f"  not trapped: {x:+.3f} {y:+.3f}")
    if arguments.out is not None:
        row = {
            "static": arguments.static,
            "episodes": arguments.episodes,
            "reachable": int(reachable.sum()),
            "success": share._asdict(),
        }
        about = {"machine": machine(), "versions": library_versions(), "scene": scene.digest()}
        write_json(arguments.out, {"config": asdict(arguments) | {"out": str(arguments.out)}} | about | {"rows": [row]})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
