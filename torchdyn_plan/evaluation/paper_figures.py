"""The figures of papers, drawn again in their own arrangement: their curves, and the results of our sweeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict

from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.curves import PaperLine, PaperMoments, PaperPanel
from torchdyn_plan.evaluation.plots import axis_label
from torchdyn_plan.files import (
    check_writable_folder,
    files_in,
    is_folder,
    read_json,
    short_path,
    write_json,
    write_whole,
)
from torchdyn_plan.schemas import check_content
from torchdyn_plan.tasks.task import Task, load_task, task_names
from torchdyn_plan.versions import library_versions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
"""The results of a checkout; an installed package has none."""
FORMATS = ("svg", "png")

_PALETTE = ("#0072B2", "#D55E00", "#009E73", "#56B4E9", "#E69F00", "#CC79A7", "#000000", "#7F7F7F")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<")
"""Of the lines of a task, in their order: colours of Okabe and Ito, which colour-blind readers can tell apart."""
_GREY = "#555555"


class _Config(TypedDict):
    """What the configuration of a sweep must say to be found."""

    task: str
    static: str
    scene: str
    over: str
    split: str


class _Rates(TypedDict):
    """What is drawn of a `torchdyn_plan.evaluation.results.ResultRow`."""

    planner: str
    settings: dict[str, Any]
    episodes: int
    success: float
    success_solvable: float | None


class _Row(_Rates, total=False):
    """The same, with what rows of a single series may lack."""

    repeats: int
    success_repeats: tuple[float, float] | None
    success_solvable_repeats: tuple[float, float] | None


class Sweep(NamedTuple):
    """The results of a sweep in a file."""

    path: Path
    config: _Config
    rows: list[_Row]


class Point(NamedTuple):
    """A success rate of ours."""

    x: float
    mean: float
    deviation: float | None
    """Standard deviation over the series of episodes; None if there was one series."""
    episodes: int
    repeats: int


class DrawnLine(NamedTuple):
    """What is drawn of a line of a paper's figure."""

    task: str
    panel: PaperPanel
    line: PaperLine
    points: list[Point]
    paper: tuple[list[float], list[float]] | None

    def told(self) -> dict[str, Any]:
        """For ``report.json``."""
        paper = None if self.paper is None else dict(zip(("x", "success"), self.paper, strict=True))
        about = {"task": self.task, "figure": self.panel.figure, "panel": self.panel.title}
        points = [point._asdict() for point in self.points]
        return about | {"planner": self.line.planner, "static": self.line.static, "ours": points, "paper": paper}


class Report(NamedTuple):
    """What `draw_report` has done."""

    files: list[Path]
    missing: list[str]
    """A line for each of the paper's curves of which there are no results of ours."""


def draw_report(
    out: str | Path, *, results: str | Path | None = None, tasks: Sequence[Task | str] | None = None
) -> Report:
    """Draw the figures of the papers of ``tasks`` with our results in them, each as SVG and PNG.

    Solid lines are our success rates with the standard deviation over the series of episodes as a band, dashed ones
    the paper's. ``report.json`` has their points. Results are those of the sweeps anywhere in ``results`` that are of
    the figure's task, scene and settings; of several that have a point the one of most series of episodes is taken.

    Args:
        out: folder for the figures.
        results: folder of results; those of the checkout for None.
        tasks: tasks, or their names; all that are known for None.

    Raises:
        InputError: there is no such folder, it has no sweep of any of the figures, a file in it is damaged, or none
            of the tasks has a paper's figures.
        OutputError: the folder cannot be written to.
    """
    known = [load_task(task) for task in (task_names() if tasks is None else tasks)]
    known = [task for task in known if task.paper is not None]
    if not known:
        raise InputError("none of the tasks has figures of a paper")
    lines, moments = _collect(known, read_sweeps(RESULTS if results is None else Path(results)))
    folder = check_writable_folder(Path(out))
    files = []
    for name in dict.fromkeys(panel.figure for panel in [*(one.panel for one in lines), *moments]):
        figure = _draw(known, [one for one in lines if one.panel.figure == name], _of(name, moments))
        files += [_save(figure, folder / f"{name}.{ending}") for ending in FORMATS]
    files.append(folder / "report.json")
    write_json(files[-1], {"versions": library_versions(), "lines": [one.told() for one in lines]})
    lacking = [f"{one.panel.figure}: {one.panel.title}: {one.line.label}" for one in lines if not one.points]
    return Report(files, lacking)


def read_sweeps(folder: Path) -> list[Sweep]:
    """The sweeps anywhere in ``folder``; raises `InputError` if it has none, or a file that is no JSON."""
    if not is_folder(folder):
        hint = "give one that holds sweeps, as benchmarks/results of a checkout does"
        raise InputError(f"results folder {short_path(folder)} does not exist: {hint}")
    found = []
    for path in files_in(folder, "**/*.json"):
        content = read_json(path)
        config = content.get("config") if isinstance(content, dict) else None
        # Figures of other kinds lie there, too, and sweeps of former versions, which name no scene.
        if isinstance(config, dict) and _Config.__required_keys__ <= config.keys():
            where = short_path(path)
            check_content(config, _Config, where, entry="config")
            found.append(
                Sweep(path, content["config"], check_content(content.get("rows"), list[_Row], where, entry="rows"))
            )
    if not found:
        raise InputError(f"results folder {short_path(folder)} holds no sweep")
    return found


def _collect(tasks: Sequence[Task], sweeps: Sequence[Sweep]) -> tuple[list[DrawnLine], list[PaperMoments]]:
    """All lines and number lines of the tasks' figures; raises `InputError` if there are no results for any of them."""
    lines, moments = [], []
    for task in tasks:
        assert task.paper is not None
        paper = task.paper()
        for panel in paper.panels():
            if isinstance(panel, PaperMoments):
                moments.append(panel)
                continue
            settings = task.default_settings(**panel.settings)
            for line in panel.lines:
                points = _points(task, panel, line, sweeps)
                theirs = paper.curve(line.planner, line.static, panel.over, settings, solvable=panel.solvable)
                lines.append(DrawnLine(task.name, panel, line, points, theirs))
    if not any(one.points for one in lines):
        raise InputError(f"no sweep among the results is of a paper's figure of {', '.join(one.name for one in tasks)}")
    return lines, moments


def _points(task: Task, panel: PaperPanel, line: PaperLine, sweeps: Sequence[Sweep]) -> list[Point]:
    """Our points of a line, by ascending abscissa."""
    scene = (task.in_scene(panel.scene) if panel.scene else task).digest()
    wanted = {"task": task.name, "static": line.static, "scene": scene, "over": panel.over, "split": "test"}
    best: dict[float, Point] = {}
    for sweep in sweeps:
        if any(sweep.config[name] != value for name, value in wanted.items()) or _is_disturbed(sweep.config):
            continue
        for row in sweep.rows:
            if row["planner"] == line.planner and _is_at(task, panel, row["settings"]):
                point = _point(panel, row)
                if point is not None and _weight(point) > _weight(best.get(point.x)):
                    best[point.x] = point
    return [best[x] for x in sorted(best)]


def _is_disturbed(config: Mapping[str, Any]) -> bool:
    """Whether plans came late or targets were measured, which no paper's figure has."""
    return any(config.get(name) is not None for name in ("delivery", "sensor", "track"))


def _is_at(task: Task, panel: PaperPanel, settings: Mapping[str, Any]) -> bool:
    """Whether ``settings`` are the panel's, except for the one along its axis."""
    if panel.over not in settings:
        return False
    others = {name: value for name, value in settings.items() if name != panel.over}
    defaults = task.default_settings(**panel.settings)
    return all(getattr(defaults, name, None) == value for name, value in others.items())


def _point(panel: PaperPanel, row: _Row) -> Point | None:
    """The row's point; None of a rate over solvable episodes where there are none."""
    rate, spread = row["success"], row.get("success_repeats")
    if panel.solvable:
        rate, spread = row["success_solvable"], row.get("success_solvable_repeats")
    if rate is None:
        return None
    mean, deviation = (rate, None) if spread is None else spread
    return Point(float(row["settings"][panel.over]), mean, deviation, row["episodes"], row.get("repeats", 1))


def _weight(point: Point | None) -> tuple[int, int]:
    """Rank of a point: more series first, then more episodes."""
    return (0, 0) if point is None else (point.repeats, point.episodes)


def _of(name: str, moments: Sequence[PaperMoments]) -> list[PaperMoments]:
    return [one for one in moments if one.figure == name]


def _draw(tasks: Sequence[Task], lines: Sequence[DrawnLine], moments: Sequence[PaperMoments]) -> Figure:
    """A figure in the paper's arrangement."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    places = [*(one.panel.place for one in lines), *(one.place for one in moments)]
    rows, columns = (1 + max(place[axis] for place in places) for axis in (0, 1))
    figure = Figure(figsize=(5.2 * columns, 3.4 * rows + 1.0), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    for place in dict.fromkeys(places):
        axes = figure.add_subplot(rows, columns, 1 + place[0] * columns + place[1])
        axes.spines[["top", "right"]].set_visible(False)
        for one in moments:
            if one.place == place:
                _draw_moments(axes, one)
        mine = [one for one in lines if one.panel.place == place]
        if mine:
            _draw_panel(axes, next(task for task in tasks if task.name == mine[0].task), mine)
    _draw_legend(figure)
    return figure


def _save(figure: Figure, path: Path) -> Path:
    """Write the figure, the same bytes each time; returns ``path``."""
    from matplotlib import rc_context

    ending = path.suffix.lstrip(".")
    about = {"Date": None} if ending == "svg" else None
    with rc_context({"svg.hashsalt": path.stem}):
        write_whole(path, lambda place: figure.savefig(place, format=ending, metadata=about))
    return path


def _draw_panel(axes: Axes, task: Task, lines: Sequence[DrawnLine]) -> None:
    panel = lines[0].panel
    for one in lines:
        style: dict[str, Any] = {"color": _PALETTE[_number(task, one.line)], "label": one.line.label}
        if one.points:
            xs, means = [point.x for point in one.points], [point.mean for point in one.points]
            axes.plot(xs, means, marker=_MARKERS[_number(task, one.line)], markersize=4, linewidth=1.6, **style)
            _draw_band(axes, one.points, style["color"])
        if one.paper is not None:
            axes.plot(*one.paper, "--", linewidth=1.0, alpha=0.85, **style)
    axes.set(title=panel.title, ylim=(0, 1.04), xlabel=axis_label(task, panel.over), ylabel="success rate")
    axes.grid(alpha=0.3)


def _draw_band(axes: Axes, points: Sequence[Point], colour: str) -> None:
    """One standard deviation on either side, where there were several series."""
    spread = [
        (one.x, one.mean - one.deviation, one.mean + one.deviation) for one in points if one.deviation is not None
    ]
    if spread:
        xs, low, high = zip(*spread, strict=True)
        axes.fill_between(xs, low, high, color=colour, alpha=0.15, linewidth=0)


def _number(task: Task, line: PaperLine) -> int:
    """Place of a line among all lines of the task's figures, so that it looks alike in each of them."""
    assert task.paper is not None
    panels = [panel for panel in task.paper().panels() if isinstance(panel, PaperPanel)]
    known = dict.fromkeys(one[:2] for panel in panels for one in panel.lines)
    return list(known).index(line[:2]) % len(_PALETTE)


def _draw_moments(axes: Axes, moments: PaperMoments) -> None:
    colours = dict(zip(moments.rows, (_GREY, *_PALETTE), strict=False))
    for row, (name, steps) in enumerate(moments.rows.items()):
        axes.axhline(row, color=_GREY, linewidth=0.8, alpha=0.5)
        axes.plot(steps, [row] * len(steps), "o", color=colours[name], markersize=6)
        axes.annotate(f"{len(steps)}", (moments.end, row), xytext=(4, 6), textcoords="offset points")
    names = [*moments.rows]
    axes.set(title=moments.title, xlim=(0, moments.end), ylim=(len(names) - 0.3, -0.7), xlabel=moments.axis)
    axes.set_yticks(range(len(names)), names)


def _draw_legend(figure: Figure) -> None:
    """Colours of the lines, and what solid and dashed mean."""
    from matplotlib.lines import Line2D

    found: dict[str, Any] = {}
    for axes in figure.axes:
        for line, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, line)
    solid = Line2D([], [], color=_GREY, linewidth=1.6)
    dashed = Line2D([], [], color=_GREY, linewidth=1.0, linestyle="--")
    found |= {"ours: mean ± standard deviation": solid, "the paper's": dashed}
    figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=3, frameon=False)
