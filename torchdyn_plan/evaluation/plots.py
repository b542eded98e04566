"""Figures of results, beside the paper's. matplotlib is imported where a figure is drawn."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdyn_plan.evaluation.intervals import Rate
from torchdyn_plan.evaluation.paper import Sweep, paper_curve, paper_reach
from torchdyn_plan.evaluation.results import ResultRow
from torchdyn_plan.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {
    "pursuit": "#D55E00",
    "corner": "#0072B2",
    "oracle": "#009E73",
    "exact": "#CC79A7",
    "meet": "#E69F00",
    "wait": "#56B4E9",
    "dher": "#56B4E9",
}
"""The colour of each planner: the palette of Okabe and Ito, told apart by colour-blind readers too."""

MARKERS = {
    "pursuit": "s", "corner": "o", "oracle": "^", "exact": "D", "meet": "v", "wait": "P", "dher": "P",
}  # fmt: skip

_GREY = "#555555"
_PALETTE = ("#0072B2", "#56B4E9", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#000000")
_PANELS = (("all episodes", False), ("solvable episodes", True))
_REACH_AXIS = "velocity of the goal [m per control step]"
_AXES = {"velocity": "velocity of the ball [m/s]", "friction": "friction loss of the ball [N]"}


def plot_results(rows: Sequence[ResultRow], path: Path) -> None:
    """Success of each planner with its 95 % interval and the paper's figure, over all and over solvable episodes.

    Args:
        rows: one row a planner, all at one setting.
        path: file to write; its ending chooses the format.

    Raises:
        OutputError: the file cannot be written.
    """
    figure, panels = _panels(height=1.5 + 0.5 * len(rows))
    for axes, (title, solvable) in zip(panels, _PANELS, strict=True):
        for line, row in enumerate(rows):
            _draw_row(axes, line, row, solvable)
        axes.set(title=title, xlim=(0, 1), xlabel="success rate", ylim=(len(rows) - 0.5, -0.5))
        axes.set_yticks(range(len(rows)), [row.planner for row in rows])
        axes.grid(axis="x", alpha=0.3)
    if any(row.paper_success is not None for row in rows):
        panels[0].plot([], [], "|", color=_GREY, markersize=10, markeredgewidth=2, label="paper")
        figure.legend(loc="outside lower center", frameon=False)
    row = rows[0]
    unit = "m a step" if row.task == "reach" else f"m/s, friction {row.friction:g}"
    figure.suptitle(f"{row.task}, {row.static} planner, {row.velocity:g} {unit}, {row.episodes} episodes")
    _save(figure, path)


def plot_sweep(rows: Sequence[ResultRow], over: Sweep, path: Path) -> None:
    """Success over velocity or friction, a curve a planner with its 95 % band, the paper's curves dashed.

    Args:
        rows: one row for each planner and value.
        over: ``velocity`` or ``friction``, the axis.
        path: file to write; its ending chooses the format.

    Raises:
        OutputError: the file cannot be written.
    """
    figure, panels = _panels(height=4.2)
    for axes, (title, solvable) in zip(panels, _PANELS, strict=True):
        for planner in dict.fromkeys(row.planner for row in rows):
            mine = sorted((row for row in rows if row.planner == planner), key=lambda row: getattr(row, over))
            _draw_curve(axes, mine, over, solvable)
        axes.set(title=title, ylim=(0, 1), xlabel=_AXES[over])
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("success rate")
    panels[0].plot([], [], "--", color=_GREY, label="paper")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    _save(figure, path)


def plot_reach(rows: Sequence[ResultRow], path: Path) -> None:
    """Success on Reach over the goal's velocity beside the paper's Figure 5: its planner and DHER dashed.

    The grey line is the ceiling: the share of episodes that a search which knows the goal's path solves.

    Args:
        rows: one row for each planner and velocity.
        path: file to write; its ending chooses the format.

    Raises:
        OutputError: the file cannot be written.
    """
    figure, (axes,) = _panels(height=4.6, count=1)
    ceiling = sorted({(row.velocity, row.solvable) for row in rows})
    axes.plot(*zip(*ceiling, strict=True), color=_GREY, linewidth=3, alpha=0.4, label="ceiling")
    for planner in dict.fromkeys(row.planner for row in rows):
        mine = sorted((row for row in rows if row.planner == planner), key=lambda row: row.velocity)
        _draw_curve(axes, mine, "velocity", solvable=False)
    if rows[0].motion == "straight":
        for method, colour, name in (("dynamic", COLOURS["corner"], "paper"), ("dher", _GREY, "paper, DHER")):
            axes.plot(*paper_reach(method), "--", color=colour, linewidth=1.2, label=name)
    axes.set(title=f"Reach, goals move: {rows[0].motion}", ylim=(0, 1.02), xlabel=_REACH_AXIS, ylabel="success rate")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right center", frameon=False)
    _save(figure, path)


def plot_bench(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Median time for one item over the batch, a panel for each task and a line for each implementation.

    Args:
        rows: those of a benchmark.
        path: file to write; its ending chooses the format.

    Raises:
        OutputError: the file cannot be written.
    """
    tasks = [task for task in dict.fromkeys(row["what"] for row in rows) if _batches(rows, task) > 1]
    kinds = list(dict.fromkeys(_implementation(row) for row in rows if row["what"] in tasks))
    figure, panels = _panels(height=4.6, count=len(tasks))
    for axes, task in zip(panels, tasks, strict=True):
        for index, kind in enumerate(kinds):
            mine = [row for row in rows if row["what"] == task and _implementation(row) == kind]
            x, y = [row["batch"] for row in mine], [row["median_us"] / row["batch"] for row in mine]
            style = "--" if "compiled" in kind else "-"
            axes.loglog(x, y, style, color=_PALETTE[index % len(_PALETTE)], marker="o", markersize=4, label=kind)
        axes.set(title=task, xlabel="batch")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("median time for one [µs]")
    labels = {label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=4, frameon=False)
    _save(figure, path)


def _implementation(row: Mapping[str, Any]) -> str:
    """Name of a line."""
    device = "" if row["device"] == "cpu" else f", {row['device']}"
    return f"{row['implementation']}{', compiled' if row['compiled'] else ''}{device}"


def _batches(rows: Sequence[Mapping[str, Any]], task: str) -> int:
    return len({row["batch"] for row in rows if row["what"] == task})


def _success(row: ResultRow, solvable: bool) -> Rate | None:
    value = row.success_solvable if solvable else row.success
    return None if value is None else Rate(value, *(row.success_solvable_ci if solvable else row.success_ci))


def _draw_row(axes: "Axes", line: int, row: ResultRow, solvable: bool) -> None:
    rate = _success(row, solvable)
    paper = row.paper_success_solvable if solvable else row.paper_success
    if rate is not None:
        axes.barh(line, rate.value, height=0.55, color=COLOURS.get(row.planner, _GREY), alpha=0.75)
        reach = [[rate.value - rate.low], [rate.high - rate.value]]
        axes.errorbar(rate.value, line, xerr=reach, color="black", capsize=3, linewidth=1.2)
        axes.text(0.015, line, f"{100 * rate.value:.0f} %", va="center")
    if paper is not None:
        axes.plot(paper, line, "|", color=_GREY, markersize=20, markeredgewidth=2)


def _draw_curve(axes: "Axes", rows: Sequence[ResultRow], over: Sweep, solvable: bool) -> None:
    known = [(row, rate) for row in rows if (rate := _success(row, solvable)) is not None]
    planner, static = rows[0].planner, rows[0].static
    colour = COLOURS.get(planner, _GREY)
    x = [getattr(row, over) for row, _ in known]
    low, high = [rate.low for _, rate in known], [rate.high for _, rate in known]
    axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
    axes.plot(
        x,
        [rate.value for _, rate in known],
        color=colour,
        marker=MARKERS.get(planner, "o"),
        markersize=4,
        label=planner,
    )
    paper = None if rows[0].task == "reach" else paper_curve(planner, static, over, solvable=solvable)
    if paper is not None:
        axes.plot(*paper, "--", color=colour, linewidth=1.0, alpha=0.8)


def _panels(height: float, count: int = 2) -> tuple["Figure", list["Axes"]]:
    """Panels side by side that share the upright axis, drawn without a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(9.0, 3.5 * count), height), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    panels = [figure.add_subplot(1, count, 1)]
    for index in range(2, count + 1):
        panels.append(figure.add_subplot(1, count, index, sharey=panels[0]))
        panels[-1].tick_params(labelleft=False)
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _save(figure: "Figure", path: Path) -> None:
    write_whole(path, lambda temporary: figure.savefig(temporary, format=path.suffix.lstrip(".") or "png"))
