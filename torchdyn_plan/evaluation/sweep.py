"""Results along the values of one setting: a file for each point, so that a killed sweep continues."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

from torchdyn_plan.checks import check_choice, check_count, check_seed
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.engines import Engine, Job, find_engine
from torchdyn_plan.evaluation.identity import (
    POINTS,
    SWEEP,
    check_sweep_folder,
    clear_results,
    digest_of,
    identity_of,
)
from torchdyn_plan.evaluation.plots import plot_sweep
from torchdyn_plan.evaluation.results import EpisodeOutcomes, ResultRow, over_repeats, write_results
from torchdyn_plan.evaluation.study import Planners, Study
from torchdyn_plan.files import check_writable_folder, exists, read_json, short_path, write_json
from torchdyn_plan.planners import Delivery, Track
from torchdyn_plan.progress import progress_bar
from torchdyn_plan.schemas import check_content
from torchdyn_plan.tasks.task import Settings, Task, load_task


class Point(TypedDict):
    """One value and repeat in a file."""

    identity: str
    """Digest of the sweep and the point."""
    content: str
    """Digest of the planners' outcomes, to detect damage."""
    planners: dict[str, dict[str, Any]]
    """Outcomes of each planner's episodes."""


def sweep(
    task: Task | str,
    planners: Planners | None = None,
    *,
    over: str,
    out: str | Path,
    values: Sequence[float] | None = None,
    repeats: int = 10,
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
    overwrite: bool = False,
    progress: bool = True,
    engine: str = "here",
    workers: int | None = None,
    **settings: Any,
) -> list[ResultRow]:
    """Evaluate planners along the values of a setting, and write ``results.json`` and ``sweep.png``.

    Points that the folder already holds are not run again.

    Args:
        task: a task, or its name as `load_task` takes it.
        planners: as of `evaluate`.
        over: the setting that varies.
        out: folder of the sweep.
        values: values of that setting; None for those of the paper's curve, or the task's own if there is none.
        repeats: series of episodes for each value, with seeds counting up from ``seed``.
        static: see `evaluate`, as for all further arguments.
        episodes: number of episodes for each planner, value and repeat.
        seed: the first series of episodes.
        split: ``test`` or ``dev``.
        num_envs: episodes simulated at once.
        num_threads: of the simulation, 0 for all cores.
        delivery: when plans become available.
        sensor: sensor model of the target.
        track: filter between sensor and planner.
        weights: folder of the networks of named planners.
        other_scene: allow planners that belong to another scene.
        overwrite: remove all results in the folder, including points of this sweep.
        progress: show progress bars.
        engine: ``here`` or ``ray``, which runs the points in workers of a Ray cluster, with the same results except for
            the times that they took.
        workers: number of Ray workers, with one thread each; one per processor for None.
        settings: the task's other settings, by name.

    Returns:
        A row for each value and planner, over the episodes of all repeats.

    Raises:
        InputError: an unknown name, a number out of range, or the folder holds an evaluation, a sweep with another
            configuration or a damaged point.
        WeightsError: weights are missing or damaged.
        OutputError: the folder cannot be written to.
    """
    task = load_task(task)
    check_choice(f"setting of {task.name} to sweep over", over, sweepable(task))
    run = find_engine(engine, workers)
    check_count("repeats", repeats, maximum=100_000)
    check_seed(seed)
    base = task.default_settings(**settings)
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
    chosen = sorted(values) if values else default_values(task, over, study.static, base)
    if len(set(chosen)) < len(chosen):
        raise InputError(f"values must differ, got {' '.join(map(str, chosen))}")
    points = {value: dataclasses.replace(base, **{over: value}) for value in chosen}
    return _Sweep(study, over, points, repeats, seed, check_writable_folder(Path(out)), run).run(overwrite)


def sweepable(task: Task) -> list[str]:
    """Names of the settings that a sweep can vary."""
    return [one.name for one in dataclasses.fields(task.settings) if one.metadata.get("sweep")]


def default_values(task: Task, over: str, static: str, settings: Settings) -> list[float]:
    """Values in the paper's figure, if it varies ``over`` at these settings; else the task's own values."""
    if task.paper is not None:
        paper = task.paper()
        curves = (paper.curve(planner, static, over, settings, solvable=False) for planner in task.planners)
        known = next(filter(None, curves), None)
        if known is not None:
            return known[0]
    own = next(one.metadata["sweep"] for one in dataclasses.fields(task.settings) if one.name == over)
    return [float(value) for value in own]


@dataclass(frozen=True)
class _Sweep:
    """Points of a study in a folder."""

    study: Study
    over: str
    points: Mapping[float, Settings]
    """Settings at each value."""
    repeats: int
    seed: int
    out: Path
    engine: Engine

    def run(self, overwrite: bool) -> list[ResultRow]:
        """Run the points that the folder lacks, and combine all requested points."""
        if overwrite:
            clear_results(self.out)
        if not check_sweep_folder(self.out, self._identity()):
            write_json(self.out / SWEEP, self._identity())
        self._run_missing_points()
        rows = [row for value in self.points for row in self._rows_at(value)]
        write_results(self.out, self.study.task, self._config(), rows)
        plot_sweep(self.study.task, rows, self.over, self.out / "sweep.png")
        return rows

    def _config(self) -> dict[str, Any]:
        settings = dataclasses.asdict(next(iter(self.points.values())))
        del settings[self.over]
        own = {"over": self.over, "values": list(self.points), "repeats": self.repeats, "seed": self.seed}
        return self.study.config() | {"settings": settings} | own

    def _identity(self) -> dict[str, Any]:
        """Everything that determines the outcome of the points."""
        return identity_of(self._config())

    def _digest(self, value: float, repeat: int) -> str:
        """Digest of the sweep and the point."""
        return digest_of(self._identity() | {self.over: value, "seed": self.seed + repeat})

    def _run_missing_points(self) -> None:
        missing = [point for point in self._all_points() if not exists(self._path(*point))]
        jobs = {(value, repeat): Job(self.points[value], self.seed + repeat) for value, repeat in missing}
        done, quiet = self.engine(self.study, jobs), not (missing and self.study.progress)
        bar = progress_bar(done, desc=f"sweep over {self.over}", unit="point", disable=quiet, total=len(missing))
        for (value, repeat), outcomes in bar:
            planners = {name: episodes.to_json(self.study.task) for name, episodes in outcomes.items()}
            point = Point(identity=self._digest(value, repeat), content=digest_of(planners), planners=planners)
            write_json(self._path(value, repeat), point)

    def _all_points(self) -> Iterator[tuple[float, int]]:
        """All values of a repeat before the next repeat, so that an early look at the folder shows the whole range."""
        return ((value, repeat) for repeat in range(self.repeats) for value in self.points)

    def _path(self, value: float, repeat: int) -> Path:
        return self.out / POINTS / f"{self.over}-{float(value)!r}-repeat-{repeat:02d}.json"

    def _rows_at(self, value: float) -> list[ResultRow]:
        """A row for each planner at ``value``, over all repeats."""
        repeats = [self._read_point(value, repeat) for repeat in range(self.repeats)]
        merged = {name: EpisodeOutcomes.merge([point[name] for point in repeats]) for name in self.study.planners}
        rows = self.study.summarize(self.points[value], merged)
        return [over_repeats(row, [point[row.planner] for point in repeats]) for row in rows]

    def _read_point(self, value: float, repeat: int) -> dict[str, EpisodeOutcomes]:
        """Outcomes by planner; raises `InputError` if the file is damaged or of another point."""
        path = self._path(value, repeat)
        try:
            point: Point = check_content(read_json(path), Point, short_path(path))
            if point["identity"] != self._digest(value, repeat):
                raise InputError("it is of another sweep, or of another point")
            if point["content"] != digest_of(point["planners"]):
                raise InputError("it differs from what was written")
            return {name: self._outcomes(point, name) for name in self.study.planners}
        except InputError as error:
            raise InputError(f"point {short_path(path)} is damaged ({error}): delete it to run it again") from error

    def _outcomes(self, point: Point, name: str) -> EpisodeOutcomes:
        if name not in point["planners"]:
            raise InputError(f"it lacks planner {name!r}")
        outcomes = EpisodeOutcomes.from_json(point["planners"][name], self.study.task)
        if outcomes.episodes != self.study.episodes:
            raise InputError(f"it has {outcomes.episodes} episodes of {name}, not {self.study.episodes}")
        return outcomes
