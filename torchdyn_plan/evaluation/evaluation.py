"""How good are planners for a moving target? The same episodes for each of them, and what came of it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchdyn_plan.checks import check_number
from torchdyn_plan.evaluation.plots import plot_results
from torchdyn_plan.evaluation.report import format_table
from torchdyn_plan.evaluation.results import EpisodeOutcomes, ResultRow, write_results
from torchdyn_plan.evaluation.study import Planners, Study
from torchdyn_plan.planners import Delivery
from torchdyn_plan.tasks.task import Task, load_task


@dataclass(frozen=True, kw_only=True, eq=False)
class Evaluation:
    """What came of an evaluation."""

    task: Task
    rows: list[ResultRow]
    """A row for each planner."""
    outcomes: dict[str, EpisodeOutcomes]
    """How each episode ended, by planner."""
    config: dict[str, Any]
    """What was run."""

    def table(self) -> str:
        """The rows as text."""
        return format_table(self.task, self.rows)

    def save(self, folder: str | Path) -> None:
        """Write ``results.json``, ``episodes.json`` and the plot ``results.png``.

        Raises:
            OutputError: the folder cannot be written to.
        """
        folder = Path(folder)
        write_results(folder, self.task, self.config, self.rows, self.outcomes)
        plot_results(self.task, self.rows, folder / "results.png")


def evaluate(
    task: Task | str,
    planners: Planners | None = None,
    *,
    static: str | None = None,
    episodes: int = 100,
    seed: int = 0,
    split: str = "test",
    num_envs: int = 64,
    num_threads: int = 0,
    delivery: Delivery | None = None,
    weights: str | Path | None = None,
    other_scene: bool = False,
    progress: bool = True,
    **settings: Any,
) -> Evaluation:
    """Let each planner play the same episodes, 0 to E-1.

    Args:
        task: a task, or its name as `load_task` takes it.
        planners: any planners by name, or names of the task's own; those that run by default for None.
        static: name of the task's static planner: named planners are built on it, and it decides which episodes count
            as solvable; the task's default one for None.
        episodes: number E of episodes for each planner.
        seed: which series of episodes.
        split: which family of series: ``test``, or ``dev`` for tuning.
        num_envs: episodes that run side by side; does not change the results of the task's own planners.
        num_threads: of the simulation, 0 for all cores; does not change the results.
        delivery: how plans come into use, `torchdyn_plan.planners.Delayed` for one; planners that make no plans have
            none.
        weights: folder of the networks of named planners, as ``train`` leaves it; those that ship for None.
        other_scene: let planners of another scene play, too.
        progress: show progress bars.
        settings: of the task, by name; the others are at their defaults.

    Raises:
        InputError: an unknown name, a number out of range, or a planner that belongs to another scene.
        WeightsError: weights are missing or damaged.
    """
    task = load_task(task)
    chosen = task.default_settings(**settings)
    check_number("seed", seed, minimum=0, integer=True)
    study = Study.of(
        task,
        planners,
        static=static,
        weights=weights,
        delivery=delivery,
        other_scene=other_scene,
        episodes=episodes,
        split=split,
        num_envs=num_envs,
        num_threads=num_threads,
        progress=progress,
    )
    outcomes = study.run(chosen, seed)
    config = study.config() | {"settings": dataclasses.asdict(chosen), "seed": seed}
    return Evaluation(task=task, rows=study.summarize(chosen, outcomes), outcomes=outcomes, config=config)
