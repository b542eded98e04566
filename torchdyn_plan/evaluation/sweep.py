"""Results along a range of velocities or frictions: one file a point, so that a killed sweep continues."""

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from torchdyn_plan.checks import check_writable_folder
from torchdyn_plan.cli_arguments import DHER_READING, EvaluateArguments, SweepArguments
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.paper import paper_curve, paper_reach
from torchdyn_plan.evaluation.plots import plot_reach, plot_sweep
from torchdyn_plan.evaluation.results import EpisodeOutcomes, ResultRow, summarize, write_results
from torchdyn_plan.files import write_json
from torchdyn_plan.versions import library_versions

RunPoint = Callable[[EvaluateArguments], Mapping[str, EpisodeOutcomes]]
"""Runs all planners at one setting: the outcomes of the same episodes by planner."""

_FREE = ("out", "values", "repeats", "num_envs", "threads")
"""Arguments that may differ when a sweep continues: they add points, or do not change them."""


def sweep(arguments: SweepArguments, run_point: RunPoint) -> list[ResultRow]:
    """Run the points that the folder lacks, then write ``results.json`` and ``sweep.png`` from all that were asked for.

    Args:
        arguments: what to run, and the folder.
        run_point: runs one setting.

    Returns:
        A row for each value and planner, over the episodes of all repeats.

    Raises:
        InputError: the folder holds a sweep with another configuration, or a damaged point.
        OutputError: the folder cannot be written to.
    """
    check_writable_folder(arguments.out)
    _claim_folder(arguments)
    _run_missing_points(arguments, run_point)
    rows = [row for value in _values(arguments) for row in _rows_at(arguments, value)]
    write_results(arguments.out, _config(arguments), rows)
    if arguments.task == "reach":
        plot_reach(rows, arguments.out / "sweep.png")
    else:
        plot_sweep(rows, arguments.over, arguments.out / "sweep.png")
    return rows


def _values(arguments: SweepArguments) -> list[float]:
    """The values asked for, or those of the paper's figure."""
    if arguments.values:
        return sorted(arguments.values)
    if arguments.task == "reach":
        return paper_reach("dynamic")[0]
    curve = paper_curve("corner", arguments.static, arguments.over, solvable=False)
    return [] if curve is None else curve[0]


def _config(arguments: SweepArguments) -> dict[str, Any]:
    fields = dataclasses.asdict(arguments) | {"out": str(arguments.out), "values": _values(arguments)}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in fields.items()}


def _claim_folder(arguments: SweepArguments) -> None:
    """Write down what decides a point's outcome, or hold it against what the folder says already."""
    path = arguments.out / "sweep.json"
    identity = {name: value for name, value in _config(arguments).items() if name not in _FREE}
    identity["version"] = library_versions()["torchdyn-plan"]
    if not path.exists():
        write_json(path, identity)
        return
    there = {"task": "trapper"} | DHER_READING | _read_json(path)
    for name in (*identity, *there):
        if there.get(name) != identity.get(name):
            raise InputError(
                f"folder {str(arguments.out)!r} holds a sweep with another configuration: "
                f"{name} is {there.get(name)!r} there, {identity.get(name)!r} here"
            )


def _run_missing_points(arguments: SweepArguments, run_point: RunPoint) -> None:
    from tqdm import tqdm

    missing = [point for point in _points(arguments) if not _point_path(arguments, *point).exists()]
    for value, repeat in tqdm(missing, desc=f"sweep over {arguments.over}", unit="point", disable=not missing):
        outcomes = run_point(arguments.point(value, repeat))
        content = {planner: episodes.to_json() for planner, episodes in outcomes.items()}
        write_json(_point_path(arguments, value, repeat), content)


def _points(arguments: SweepArguments) -> Iterator[tuple[float, int]]:
    """All values of a repeat before the next repeat, so that an early look at the folder shows the whole range."""
    return ((value, repeat) for repeat in range(arguments.repeats) for value in _values(arguments))


def _point_path(arguments: SweepArguments, value: float, repeat: int) -> Path:
    return arguments.out / "points" / f"{arguments.over}-{float(value)!r}-repeat-{repeat:02d}.json"


def _rows_at(arguments: SweepArguments, value: float) -> list[ResultRow]:
    """A row for each planner at ``value``, over all repeats."""
    points = [_read_point(_point_path(arguments, value, repeat), arguments) for repeat in range(arguments.repeats)]
    setting = arguments.point(value, 0)
    return [
        summarize(
            EpisodeOutcomes.merge([point[planner] for point in points]),
            planner=planner,
            static=setting.static,
            velocity=setting.velocity,
            friction=setting.friction,
            task=arguments.task,
            motion=arguments.motion,
        )
        for planner in setting.planners
    ]


def _read_point(path: Path, arguments: SweepArguments) -> dict[str, EpisodeOutcomes]:
    try:
        content = _read_json(path)
        return {planner: EpisodeOutcomes.from_json(content[planner]) for planner in arguments.planners}
    except (InputError, KeyError, TypeError) as error:
        raise InputError(f"point {str(path)!r} is damaged ({error}): delete it to run it again") from error


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise InputError(f"{str(path)!r} is no JSON file: {error}") from error
