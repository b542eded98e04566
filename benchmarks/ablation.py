"""What each mechanism of the meeting planner is worth: switched off alone, or on alone where it is off by default.

python benchmarks/ablation.py --out benchmarks/results/ablation.json
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from torch import Tensor

from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.evaluation.intervals import paired_loss, rate
from torchdyn_plan.evaluation.planners import CHUNK, static_planner
from torchdyn_plan.evaluation.play import one_thread
from torchdyn_plan.evaluation.run import record_truth, run_episodes
from torchdyn_plan.files import write_json
from torchdyn_plan.planners import Adaptation, EventSchedule, ExactSearch, MeetingPlanner, SearchResult, search_corners
from torchdyn_plan.planners.meeting import CAUTIOUS, WAITING
from torchdyn_plan.versions import library_versions, machine

JUST_IN_TIME = replace(WAITING, margin=0.0, patience=1.0, loyalty=0.0, longest_stay=1)
"""The first meeting that the robot can be in time for: no time is left to wait."""


class CornersAbove(ExactSearch):
    """The paper's four corners in place of the whole forecast; the goal is above the meeting place all the same."""

    def __call__(self, forecast: Tensor, target_pos: Tensor, eta: Callable[..., Any], **_: Any) -> SearchResult:
        """Choose as `search_corners` does."""
        found = search_corners(forecast, target_pos, lambda goals: eta(goals, reading="mode"))
        return found._replace(goal=self.goals(found.goal))


VARIANTS: dict[str, dict[str, Any]] = {
    "meet": {},
    "without exact search": {"search": CornersAbove(height=WAITING.height, half_extent=WAITING.half_extent)},
    "without waiting": {"search": JUST_IN_TIME},
    "without matching": {"pull": 0.0},
    "without uncertainty": {"search": WAITING},
    "without shunning the arm's axis": {"search": replace(CAUTIOUS, base_pos=None)},
    "with event-triggered re-planning": {"schedule": EventSchedule()},
    "with adaptation": {"adaptation": Adaptation()},
}
"""Name → what differs from `MeetingPlanner.from_pretrained`."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Run every variant on the same episodes."""

    velocities: tuple[float, ...] = (3.0, 5.0)
    """Of the ball [m/s]."""
    frictions: tuple[float, ...] = (0.0,)
    """Friction losses of the ball [N]."""
    episodes: int = 500
    """For each variant, velocity and friction."""
    split: str = "test"
    """Series of episodes: test, or dev."""
    seed: int = 0
    """Which series."""
    num_envs: int = 500
    """Episodes side by side."""
    out: Path | None = None
    """JSON file for the figures."""


def variant(name: str) -> MeetingPlanner:
    """The meeting planner with one mechanism changed."""
    settings = dict(VARIANTS[name])
    search, adaptation = settings.pop("search", CAUTIOUS), settings.pop("adaptation", None)
    planner = MeetingPlanner.from_pretrained("trapper-ik", search=search, adaptation=adaptation, chunk=CHUNK)
    planner.static = static_planner("ik")
    planner.pull = settings.pop("pull", planner.pull)
    planner.schedule = settings.pop("schedule", planner.schedule)
    return planner


def main(arguments: Arguments) -> None:
    """Run, print and write."""
    rows: list[dict[str, Any]] = []
    for velocity in arguments.velocities:
        for friction in arguments.frictions:
            setting = EvaluateArguments(
                velocity=velocity, friction=friction, episodes=arguments.episodes, split=arguments.split,
                seed=arguments.seed, num_envs=arguments.num_envs,
            )  # fmt: skip
            whole = None
            with one_thread():
                future, solvable = record_truth(setting)
                for name in VARIANTS:
                    outcome = run_episodes(variant(name), setting, future, solvable, name)
                    trapped = outcome.trapped[solvable]
                    whole = trapped if whole is None else whole
                    value, low, high = rate(int(trapped.sum()), len(trapped))
                    row = {"variant": name, "velocity": velocity, "friction": friction, "solvable": len(trapped)}
                    row |= {"success_solvable": value, "success_solvable_ci": [low, high]}
                    row |= {"change": [-part for part in paired_loss(whole, trapped)]}
                    row |= {"replans": float(outcome.replans.double().mean())}
                    rows.append(row)
                    print("  ".join(f"{key} {entry}" for key, entry in row.items()), flush=True)
    if arguments.out is not None:
        about = {"machine": machine(), "versions": library_versions(), "scene": TrapperScene().digest()}
        write_json(arguments.out, {"config": asdict(arguments) | {"out": str(arguments.out)}} | about | {"rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
