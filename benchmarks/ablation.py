"""What each mechanism of the wait-and-drop planner is worth: switched off alone.

python benchmarks/ablation.py --out benchmarks/results/ablation.json
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import tyro
from study import Episodes, Row, Setting, Study, change_entries, each, measuring, success_of
from torch import Tensor

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.nets.arrival import ArrivalQuery
from torchdyn_plan.nets.forecast import Forecast
from torchdyn_plan.planners import EventSchedule, ExactSearch, Meeting, ReplanSchedule, SearchContext, search_corners
from torchdyn_plan.planners.search.meeting import NO_CONTEXT
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.wait_and_drop import WaitAndDrop, waiting_search

PLANNER = "wait_and_drop"
SCENE = TrapperScene()
WAITING = waiting_search(SCENE, by_probability=False)
JUST_IN_TIME = replace(WAITING, margin=0.0, waiting_cost=1.0, switching_cost=0.0, longest_dwell=1)
"""The first meeting that the robot can be in time for: no time is left to wait."""


class CornersAbove(ExactSearch):
    """The paper's four corners in place of the whole forecast; the goal is above the meeting place all the same."""

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """Choose as `search_corners` does."""
        found = search_corners(forecast.path, target_pos, eta)
        return found._replace(goal=self.goals(found.goal))


VARIANTS: dict[str, dict[str, Any]] = {
    PLANNER: {},
    "without exact search": {"search": CornersAbove(height=WAITING.height, half_extent=WAITING.half_extent)},
    "without waiting": {"search": JUST_IN_TIME},
    "without matching": {"maneuver": replace(WaitAndDrop.of(SCENE), pull=0.0)},
    "without uncertainty": {"search": WAITING},
    "without captures learned": {"capture": None, "search": waiting_search(SCENE)},
    "without shunning the arm's axis": {"search": replace(waiting_search(SCENE, by_capture=True), base_pos=None)},
    "first plan at step 13": {"schedule": ReplanSchedule.every(5, first_step=13)},
    "with event-triggered re-planning": {"schedule": EventSchedule(first_step=3)},
}
"""Name to the parts that differ from the planner that ships, which comes first."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Run every variant on the same episodes."""

    velocities: tuple[float, ...] = (3.0, 5.0)
    """Of the ball [m/s]."""
    frictions: tuple[float, ...] = (0.0,)
    """Friction losses of the ball [N]."""
    episodes: int = 500
    split: str = "test"
    num_envs: int = 500


def compare(study: Study, setting: Setting) -> None:
    """A row for each variant at one setting."""
    whole: Row | None = None
    for name in each(list(VARIANTS), str(setting.changes)):

        def measure(name: str = name, whole: Row | None = whole) -> Row:
            found = success_of(setting.play(setting.planner(PLANNER, **VARIANTS[name]), name))
            return found | change_entries(whole or found, found)

        row = study.row({"variant": name, **setting.about}, measure)
        whole = whole or row


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    with measuring():
        for velocity in arguments.velocities:
            for friction in arguments.frictions:
                compare(study, Setting(task, arguments, velocity=velocity, friction=friction))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
