"""Evaluation of planners for a moving target: the same episodes for each, and their results."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchdyn_plan.checks import check_seed
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import OutputError
from torchdyn_plan.evaluation.identity import check_evaluation_folder, clear_results
from torchdyn_plan.evaluation.plots import plot_results
from torchdyn_plan.evaluation.report import format_table
from torchdyn_plan.evaluation.results import EpisodeOutcomes, ResultRow, write_results
from torchdyn_plan.evaluation.study import Planners, Study
from torchdyn_plan.files import check_writable_folder
from torchdyn_plan.planners import Delivery, Track
from torchdyn_plan.tasks.task import Task, load_task


@dataclass(frozen=True, kw_only=True, eq=False)
class Evaluation:
    """Result of an evaluation."""

    task: Task
    rows: list[ResultRow]
    """A row for each planner."""
    outcomes: dict[str, EpisodeOutcomes]
    """Outcome of each episode, by planner."""
    config: dict[str, Any]
    """The configuration that was run."""

    def table(self) -> str:
        """The rows as text."""
        return format_table(self.task, self.rows)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Write ``results.json``, ``episodes.json`` and the plot ``results.png``.

        Args:
            folder: may already hold the same evaluation.
            overwrite: replace other results in it.

        Raises:
            InputError: the folder holds a sweep or other results.
            OutputError: the folder cannot be written to.
        """
        folder = Path(folder)
        if overwrite:
            clear_results(folder)
        check_evaluation_folder(folder, self.config)
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
    sensor: Sensor | None = None,
    track: Track | None = None,
    weights: str | Path | None = None,
    other_scene: bool = False,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: bool = True,
    **settings: Any,
) -> Evaluation:
    """Run the same episodes, 0 to E-1, with each planner.

    Args:
        task: a task, or its name as `load_task` takes it.
        planners: planners by name, or names of the task's planners; its default ones for None.
        static: name of the task's static planner: named planners are built on it, and it decides which episodes count
            as solvable; the task's default one for None.
        episodes: number E of episodes for each planner.
        seed: series of episodes.
        split: ``test``, or ``dev`` for tuning.
        num_envs: episodes simulated at once; does not change the results of the task's planners.
        num_threads: of the simulation, 0 for all cores; does not change the results.
        delivery: when plans become available, e.g. `torchdyn_plan.planners.Delayed`; ignored by planners without plans.
        sensor: sensor model of the target; exact for None.
        track: filter between sensor and planners, e.g. `torchdyn_plan.planners.KalmanTrack`; for None planners see the
            newest measurement, held from step to step.
        weights: folder of the networks of named planners, as ``train`` writes it; the shipped ones for None.
        other_scene: allow planners that belong to another scene.
        out: folder for the results; it is checked before anything runs.
        overwrite: replace other results in that folder.
        progress: show progress bars.
        settings: the task's settings by name; the others keep their defaults.

    Raises:
        InputError: an unknown name, a number out of range, a planner that belongs to another scene, or a folder that
            holds a sweep or other results.
        WeightsError: weights are missing or damaged.
        OutputError: the folder cannot be written to.
    """
    task = load_task(task)
    chosen = task.default_settings(**settings)
    check_seed(seed)
    study = Study.of(
        task,
        planners,
        static=static,
        weights=weights,
        delivery=delivery,
        sensor=sensor,
        track=track,
        other_scene=other_scene,
        episodes=episodes,
        split=split,
        num_envs=num_envs,
        num_threads=num_threads,
        progress=progress,
    )
    config = study.config() | {"settings": dataclasses.asdict(chosen), "seed": seed}
    if out is not None:
        folder = check_writable_folder(Path(out))
        if not overwrite:
            check_evaluation_folder(folder, config)
    outcomes = study.run(chosen, seed)
    found = Evaluation(task=task, rows=study.summarize(chosen, outcomes), outcomes=outcomes, config=config)
    if out is not None:
        try:
            found.save(out, overwrite=overwrite)
        except OutputError as error:
            # If saving fails, the table is at least printed.
            error.add_note(found.table())
            raise
    return found
