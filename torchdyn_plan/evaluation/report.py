"""Results as a table of text."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

from torchdyn_plan.evaluation.results import ResultRow
from torchdyn_plan.tasks.task import Task

SHORT_EPISODE = 100
"""Steps to a success are given to a tenth where episodes have fewer control steps than this."""


class Column(NamedTuple):
    """A column of the table."""

    head: str
    cell: Callable[[ResultRow], str]


def format_table(task: Task, rows: Sequence[ResultRow]) -> str:
    """An aligned table of text: one line per row, rates in per cent, the paper's figure after ours, ``–`` for none."""
    varying = _varying(rows)
    columns = [*_names(rows, varying), *_rates(task, rows), *_causes(task, rows), *_measures(rows), *_track(rows)]
    lines = [[column.head for column in columns], *([column.cell(row) for column in columns] for row in rows)]
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    first, *others = (_align(line, widths) for line in lines)
    return "\n".join([_title(task, rows, varying), "", first, "─" * len(first), *others])


def describe_setting(task: Task, name: str, value: Any) -> str:
    """A setting with its value and unit, as ``velocity 3 m/s``."""
    return " ".join(filter(None, [_spaced(name), plain(value), unit_of(task, name)]))


def unit_of(task: Task, name: str) -> str:
    """Unit of a setting of ``task``; empty for none."""
    return next(one.metadata.get("unit", "") for one in fields(task.settings) if one.name == name)


def plain(value: Any) -> str:
    """A value as it is shown."""
    return f"{value:g}" if isinstance(value, (int, float)) and not isinstance(value, bool) else str(value)


def _varying(rows: Sequence[ResultRow]) -> list[str]:
    """Names of the settings in which the rows differ."""
    return [name for name in rows[0].settings if len({row.settings[name] for row in rows}) > 1]


def _names(rows: Sequence[ResultRow], varying: Sequence[str]) -> Iterator[Column]:
    """Columns that identify a row."""
    yield Column("planner", lambda row: row.planner)
    if len({row.static for row in rows}) > 1:
        yield Column("static", lambda row: row.static)
    for name in varying:
        yield Column(_spaced(name), lambda row, name=name: plain(row.settings[name]))


def _rates(task: Task, rows: Sequence[ResultRow]) -> Iterator[Column]:
    """How often planners succeed, how soon, and how often they plan; the paper's figures where it has any."""
    digits = 1 if task.max_steps < SHORT_EPISODE else 0
    yield Column("success [95 %]", lambda row: _rate(row.success, row.success_ci))
    if any(row.paper_success is not None for row in rows):
        yield Column("paper", lambda row: _percent(row.paper_success))
    if task.truth is not None:
        yield Column("of solvable [95 %]", lambda row: _rate(row.success_solvable, row.success_solvable_ci))
    if any(row.paper_success_solvable is not None for row in rows):
        yield Column("paper", lambda row: _percent(row.paper_success_solvable))
    yield Column(task.words.steps, lambda row: _number(row.steps_to_success, digits))
    yield Column("re-plans", lambda row: _number(row.replans, 1))


def _causes(task: Task, rows: Sequence[ResultRow]) -> Iterator[Column]:
    """Shares of the causes of failure."""
    for cause in task.causes:
        if any(cause in row.failures for row in rows):
            yield Column(_spaced(cause), lambda row, cause=cause: _percent(row.failures.get(cause)))


def _measures(rows: Sequence[ResultRow]) -> Iterator[Column]:
    """The task's further figures."""
    for name in dict.fromkeys(name for row in rows for name in row.measures):
        yield Column(_spaced(name), lambda row, name=name: _number(row.measures.get(name), 2))


def _track(rows: Sequence[ResultRow]) -> Iterator[Column]:
    """Counts of the measurements that tracks used, rejected, or restarted at."""
    for name in dict.fromkeys(name for row in rows for name in row.track):
        yield Column(f"track {name}", lambda row, name=name: _number(row.track.get(name), 1))


def _title(task: Task, rows: Sequence[ResultRow], varying: Sequence[str]) -> str:
    """What all rows share, and how many of their episodes are solvable."""
    statics = {row.static for row in rows}
    parts = [task.name, *(f"static planner {static}" for static in statics if len(statics) == 1)]
    parts += [describe_setting(task, name, value) for name, value in rows[0].settings.items() if name not in varying]
    counts = sorted({row.episodes for row in rows})
    parts.append(f"{'–'.join(map(str, dict.fromkeys([counts[0], counts[-1]])))} episodes")
    if task.truth is not None and not varying:
        parts.append(f"{100 * rows[0].solvable:.0f} % solvable")
    return ", ".join(parts)


def _align(cells: Sequence[str], widths: Sequence[int]) -> str:
    name, *numbers = cells
    return "  ".join([name.ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(numbers, widths[1:], strict=True))])


def _spaced(name: str) -> str:
    return name.replace("_", " ")


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _rate(value: float | None, interval: tuple[float, float]) -> str:
    if value is None:
        return "–"
    low, high = (f"{100 * end:.0f}" for end in interval)
    return f"{100 * value:.0f} % [{low}–{high}]"
