"""Figures of results with the paper's for comparison. matplotlib is imported where a figure is drawn."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from torchdyn_plan.evaluation.intervals import Rate
from torchdyn_plan.evaluation.report import describe_setting, unit_of
from torchdyn_plan.evaluation.results import ResultRow
from torchdyn_plan.files import write_whole
from torchdyn_plan.tasks.task import Task

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Style(NamedTuple):
    """How a planner is drawn."""

    colour: str
    marker: str


STYLES = {
    "pursuit": Style("#D55E00", "s"),
    "corner": Style("#0072B2", "o"),
    "oracle": Style("#009E73", "^"),
    "exact": Style("#CC79A7", "D"),
    "wait": Style("#56B4E9", "P"),
}
"""Of planners that most tasks have: the palette of Okabe and Ito, which colour-blind readers can tell apart, too."""
FURTHER_STYLES = (Style("#E69F00", "v"), Style("#000000", "X"), Style("#8C6D31", "<"), Style("#7F7F7F", ">"))
"""Of a task's own planners, in their order, and of those given by hand."""

TITLE_WIDTH = 105
"""Characters of a title in a line."""

_GREY = "#555555"
_PALETTE = ("#0072B2", "#56B4E9", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#000000")


class _Panel(NamedTuple):
    """What a panel shows."""

    title: str
    solvable: bool

    def rate(self, row: ResultRow) -> Rate | None:
        value = row.success_solvable if self.solvable else row.success
        return None if value is None else Rate(value, *(row.success_solvable_ci if self.solvable else row.success_ci))

    def paper(self, row: ResultRow) -> float | None:
        return row.paper_success_solvable if self.solvable else row.paper_success


def plot_results(task: Task, rows: Sequence[ResultRow], path: Path) -> None:
    """Success of each planner with its 95 % interval and the paper's figure, over all and over solvable episodes.

    Args:
        task: whose results these are.
        rows: one row a planner, all at one setting.
        path: file to write; its ending chooses the format.

    Raises:
        OutputError: the file cannot be written.
    """
    panels = _panels_of(task)
    figure, all_axes = _axes(height=1.5 + 0.5 * len(rows), count=len(panels))
    styles = _styles(task, [row.planner for row in rows])
    for axes, panel in zip(all_axes, panels, strict=True):
        for line, row in enumerate(rows):
            _draw_row(axes, line, styles[row.planner].colour, panel.rate(row), panel.paper(row))
        axes.set(title=panel.title, xlim=(0, 1), xlabel="success rate", ylim=(len(rows) - 0.5, -0.5))
        axes.set_yticks(range(len(rows)), [row.planner for row in rows])
        axes.grid(axis="x", alpha=0.3)
    if any(row.paper_success is not None for row in rows):
        all_axes[0].plot([], [], "|", color=_GREY, markersize=10, markeredgewidth=2, label="paper")
        figure.legend(loc="outside lower center", frameon=False)
    _set_title(figure, task, rows[0], list(rows[0].settings))
    _save(figure, path)


def plot_sweep(task: Task, rows: Sequence[ResultRow], over: str, path: Path) -> None:
    """Success over a setting: a curve a planner with its 95 % band, and the paper's curves dashed.

    Where a task knows which episodes can be solved, a grey line shows their share, which no planner can be above.

    Args:
        task: whose results these are.
        rows: one row for each planner and value.
        over: the setting along the axis.
        path: file to write; its ending chooses the format.

    Raises:
        OutputError: the file cannot be written.
    """
    panels = _panels_of(task)
    figure, all_axes = _axes(height=4.2, count=len(panels))
    planners = list(dict.fromkeys(row.planner for row in rows))
    styles = _styles(task, planners)
    if task.truth is not None:
        shares = sorted({(row.settings[over], row.solvable) for row in rows})
        all_axes[0].plot(*zip(*shares, strict=True), color=_GREY, linewidth=3, alpha=0.4, label="solvable")
    for axes, panel in zip(all_axes, panels, strict=True):
        for planner in planners:
            _draw_curve(axes, [row for row in rows if row.planner == planner], over, panel, styles[planner])
        _draw_paper(axes, task, rows[0], over, panel)
        axes.set(title=panel.title, ylim=(0, 1.02), xlabel=axis_label(task, over))
        axes.grid(alpha=0.3)
    all_axes[0].set_ylabel("success rate")
    handles, labels = all_axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 5), frameon=False)
    _set_title(figure, task, rows[0], [name for name in rows[0].settings if name != over])
    _save(figure, path)


def plot_bench(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Median time for one item over the batch, a panel for each piece of work and a line for each implementation.

    Args:
        rows: those of a benchmark.
        path: file to write; its ending chooses the format.

    Raises:
        OutputError: the file cannot be written.
    """
    batches: dict[str, set[int]] = {}
    for row in rows:
        batches.setdefault(row["what"], set()).add(row["batch"])
    works = [work for work, sizes in batches.items() if len(sizes) > 1]
    kinds = list(dict.fromkeys(_implementation(row) for row in rows if row["what"] in works))
    figure, all_axes = _axes(height=4.6, count=len(works))
    for axes, work in zip(all_axes, works, strict=True):
        for index, kind in enumerate(kinds):
            mine = [row for row in rows if row["what"] == work and _implementation(row) == kind]
            _draw_times(axes, mine, kind, _PALETTE[index % len(_PALETTE)])
        axes.set(title=work, xlabel="batch")
        axes.grid(alpha=0.3)
    all_axes[0].set_ylabel("median time for one [µs]")
    labels = {label: line for axes in all_axes for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=4, frameon=False)
    _save(figure, path)


def _implementation(row: Mapping[str, Any]) -> str:
    """Name of a line."""
    device = "" if row["device"] == "cpu" else f", {row['device']}"
    return f"{row['implementation']}{', compiled' if row['compiled'] else ''}{device}"


def _draw_times(axes: Axes, rows: Sequence[Mapping[str, Any]], kind: str, colour: str) -> None:
    times = [row["median_us"] / row["batch"] for row in rows]
    style = "--" if "compiled" in kind else "-"
    axes.loglog([row["batch"] for row in rows], times, style, color=colour, marker="o", markersize=4, label=kind)


def _panels_of(task: Task) -> list[_Panel]:
    """All episodes, and the solvable ones where a task knows which these are."""
    everything = _Panel("all episodes", solvable=False)
    return [everything] if task.truth is None else [everything, _Panel("solvable episodes", solvable=True)]


def _styles(task: Task, planners: Iterable[str]) -> dict[str, Style]:
    """The style of each planner of ``task``, and of others."""
    names = dict.fromkeys([*task.planners, *planners])
    others = [name for name in names if name not in STYLES]
    further = {name: FURTHER_STYLES[index % len(FURTHER_STYLES)] for index, name in enumerate(others)}
    return {name: STYLES.get(name) or further[name] for name in names}


def axis_label(task: Task, over: str) -> str:
    """What stands along the axis of a setting, with its unit."""
    text = next(one.metadata.get("text", one.name) for one in fields(task.settings) if one.name == over)
    return f"{text} [{unit_of(task, over)}]" if unit_of(task, over) else text


def _set_title(figure: Figure, task: Task, row: ResultRow, settings: Iterable[str]) -> None:
    told = [describe_setting(task, name, row.settings[name]) for name in settings]
    title = ", ".join([f"{row.task}, {row.static} planner", *told, f"{row.episodes} episodes"])
    figure.suptitle(textwrap.fill(title, TITLE_WIDTH))


def _draw_row(axes: Axes, line: int, colour: str, rate: Rate | None, paper: float | None) -> None:
    if rate is not None:
        axes.barh(line, rate.value, height=0.55, color=colour, alpha=0.75)
        ends = [[rate.value - rate.low], [rate.high - rate.value]]
        axes.errorbar(rate.value, line, xerr=ends, color="black", capsize=3, linewidth=1.2)
        # Within the bar where it is long enough, else beyond the interval.
        place = 0.015 if rate.low > 0.2 else rate.high + 0.02
        axes.text(place, line, f"{100 * rate.value:.0f} %", va="center")
    if paper is not None:
        axes.plot(paper, line, "|", color=_GREY, markersize=20, markeredgewidth=2)


def _draw_curve(axes: Axes, rows: Sequence[ResultRow], over: str, panel: _Panel, style: Style) -> None:
    in_order = sorted(rows, key=lambda row: row.settings[over])
    known = [(row.settings[over], rate) for row in in_order if (rate := panel.rate(row)) is not None]
    if not known:
        return
    xs, rates = zip(*known, strict=True)
    values, low, high = zip(*rates, strict=True)
    axes.fill_between(xs, low, high, color=style.colour, alpha=0.15, linewidth=0)
    axes.plot(xs, values, color=style.colour, marker=style.marker, markersize=4, label=rows[0].planner)


def _draw_paper(axes: Axes, task: Task, row: ResultRow, over: str, panel: _Panel) -> None:
    """The paper's curves of the planners that are drawn, and of the task's rivals; ``row`` has the other settings."""
    if task.paper is None:
        return
    paper, settings = task.paper(), task.settings(**row.settings)
    drawn = [str(line.get_label()) for line in axes.get_lines()]
    ours = False
    for planner, style in _styles(task, ()).items():
        curve = paper.curve(planner, row.static, over, settings, solvable=panel.solvable)
        rival = planner in task.rivals
        if curve is None or not (rival or planner in drawn):
            continue
        # A label that begins with "_" is not in the legend.
        label = f"paper, {planner}" if rival else f"_{planner}"
        axes.plot(*curve, "--", color=style.colour, linewidth=1.1, alpha=0.8, label=label)
        ours = ours or not rival
    if ours:
        axes.plot([], [], "--", color=_GREY, label="paper")


def _axes(height: float, count: int) -> tuple[Figure, list[Axes]]:
    """Panels side by side that share the upright axis, drawn without a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(9.0, 3.5 * count), height), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    all_axes = [figure.add_subplot(1, count, 1)]
    for index in range(2, count + 1):
        all_axes.append(figure.add_subplot(1, count, index, sharey=all_axes[0]))
        all_axes[-1].tick_params(labelleft=False)
    for axes in all_axes:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, all_axes


def _save(figure: Figure, path: Path) -> None:
    write_whole(path, lambda temporary: figure.savefig(temporary, format=path.suffix.lstrip(".") or "png"))
