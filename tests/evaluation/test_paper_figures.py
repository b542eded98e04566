import json
import shutil
from pathlib import Path

import pytest

from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import paper_figures
from torchdyn_plan.evaluation.curves import PaperMoments, PaperPanel
from torchdyn_plan.evaluation.paper_figures import RESULTS, draw_report, read_sweeps
from torchdyn_plan.tasks import load_task

TRAPPER = load_task("trapper")


@pytest.fixture
def results(tmp_path):
    """A folder with one of the committed sweeps: velocity, IK, ten series."""
    folder = tmp_path / "results"
    shutil.copytree(RESULTS / "paper_velocity", folder / "deep" / "paper_velocity")
    return folder


@pytest.fixture
def drawn(monkeypatch):
    """What would be drawn; nothing is."""
    found = []

    class NoFigure:
        def savefig(self, path, format, metadata):
            Path(path).write_text(format)

    def draw(tasks, lines, moments):
        found.extend(lines)
        return NoFigure()

    monkeypatch.setattr(paper_figures, "_draw", draw)
    return found


def change(folder, **entries):
    path = folder / "deep" / "paper_velocity" / "results.json"
    content = json.loads(path.read_text())
    content["config"] |= entries
    path.write_text(json.dumps(content))


def line_of(drawn, figure, planner, *, solvable, over="velocity", static="ik"):
    (one,) = (
        one
        for one in drawn
        if one.line[:2] == (planner, static) and one.panel[0] == figure and one.panel.over == over
        if one.panel.solvable == solvable
    )
    return one


def test_points_are_those_of_the_sweep_and_of_the_paper(results, drawn, tmp_path):
    report = draw_report(tmp_path / "out", results=results, tasks=[TRAPPER])
    rows = json.loads((results / "deep" / "paper_velocity" / "results.json").read_text())["rows"]
    for solvable, name in ((False, "success_repeats"), (True, "success_solvable_repeats")):
        one = line_of(drawn, "figure4", "corner", solvable=solvable)
        expected = [(row["settings"]["velocity"], *row[name]) for row in rows if row["planner"] == "corner"]
        assert [(point.x, point.mean, point.deviation) for point in one.points] == expected
        assert one.points[0][3:] == (1000, 10)
        assert one.paper is not None
        assert len(one.paper[0]) == 21
    assert any("friction" in line and "IK" in line for line in report.missing)
    assert not any("over velocity: target pursuit, IK" in line for line in report.missing)
    names = {file.name for file in report.files}
    wanted = {
        f"{name}.{kind}" for name in ("figure4", "figure4_ik", "figure4_rl", "figure5") for kind in ("svg", "png")
    }
    assert names == wanted | {"report.json"}
    told = json.loads((tmp_path / "out" / "report.json").read_text())["lines"]
    assert len(told) == len(drawn)


def test_more_series_count_more(results, drawn, tmp_path):
    other = results / "one_series"
    shutil.copytree(results / "deep" / "paper_velocity", other)
    content = json.loads((other / "results.json").read_text())
    for row in content["rows"]:
        row |= {"success": 0.0, "repeats": 1, "success_repeats": None, "success_solvable_repeats": None}
    content["rows"].append(content["rows"][0] | {"planner": "corner", "settings": {"velocity": 5.5, "friction": 0.0}})
    (other / "results.json").write_text(json.dumps(content))
    draw_report(tmp_path / "out", results=results, tasks=[TRAPPER])
    points = line_of(drawn, "figure4", "corner", solvable=False).points
    assert [point.x for point in points] == [*(0.25 * number for number in range(21)), 5.5]
    assert (points[-1].mean, points[-1].deviation, points[-1].repeats) == (0.0, None, 1)
    assert all(point.mean > 0.1 and point.repeats == 10 for point in points[:-1])


@pytest.mark.parametrize(
    "entries", [{"scene": "another"}, {"split": "dev"}, {"static": "rl2"}, {"sensor": {}}, {"delivery": "Delayed(5)"}]
)
def test_sweeps_of_something_else_are_not_drawn(results, drawn, tmp_path, entries):
    change(results, **entries)
    with pytest.raises(InputError, match="no sweep among the results is of a paper's figure of trapper"):
        draw_report(tmp_path / "out", results=results, tasks=[TRAPPER])
    assert not (tmp_path / "out").exists()


def test_mistakes_are_told(results, tmp_path):
    with pytest.raises(InputError, match="nowhere' does not exist: give one that holds sweeps"):
        draw_report(tmp_path / "out", results=tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty' holds no sweep"):
        draw_report(tmp_path / "out", results=tmp_path / "empty")
    with pytest.raises(InputError, match="none of the tasks has figures of a paper"):
        draw_report(tmp_path / "out", results=results, tasks=["chase"])
    change(results, over=3)
    with pytest.raises(InputError, match=r"results.json'?: config.over must be a text, got 3"):
        draw_report(tmp_path / "out", results=results, tasks=[TRAPPER])


def test_a_figure_is_drawn_with_every_line_in_it(results, tmp_path):
    lines, moments = paper_figures._collect([TRAPPER], read_sweeps(results))
    chosen = [one for one in lines if one.panel.figure == "figure4_ik" and one.panel.place == (0, 1)]
    figure = paper_figures._draw([TRAPPER], chosen, moments)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    (panel,) = (axes for axes in figure.axes if axes.get_title() == "Solvable episodes, over velocity")
    # Three planners of ours with a band each and of the paper; wait and drop has no results here, and no paper's curve.
    assert len(panel.lines) == 6
    assert len(panel.collections) == 3
    assert len({line.get_color() for line in panel.lines}) == 3
    (number_line,) = (axes for axes in figure.axes if axes.get_title() == "Re-plans of an episode")
    assert [label.get_text() for label in number_line.get_yticklabels()] == ["paper", "ours"]
    one, other = (paper_figures._save(figure, tmp_path / name / "figure.svg") for name in ("a", "b"))
    assert one.stat().st_size > 10_000
    assert one.read_bytes() == other.read_bytes()


def test_the_schedule_plans_when_the_papers_does():
    assert TRAPPER.paper is not None
    (moments,) = (panel for panel in TRAPPER.paper().panels() if isinstance(panel, PaperMoments))
    assert moments.rows["ours"] == moments.rows["paper"]


def test_committed_results_have_the_papers_figures_in_them(drawn, tmp_path):
    draw_report(tmp_path, tasks=["trapper"])
    for planner in ("corner", "pursuit", "oracle"):
        for over in ("velocity", "friction"):
            for solvable in (False, True):
                one = line_of(drawn, "figure4", planner, solvable=solvable, over=over)
                assert len(one.points) >= 5
                assert all(point.deviation is not None for point in one.points)
    assert all(isinstance(one.panel, PaperPanel) for one in drawn)


def test_committed_results_have_fetch_reach_in_them(drawn, tmp_path):
    pytest.importorskip("gymnasium_robotics")
    report = draw_report(tmp_path, tasks=["fetch_reach"])
    assert report.missing == []
    for planner in ("corner", "dher"):
        (one,) = (one for one in drawn if one.line.planner == planner)
        assert one.paper is not None
        assert [point.x for point in one.points] == one.paper[0]
        assert all(point.repeats == 10 for point in one.points)


def test_the_figures_of_the_pages_are_of_the_committed_results(drawn, tmp_path):
    pytest.importorskip("gymnasium_robotics")
    draw_report(tmp_path, tasks=["trapper", "fetch_reach"])
    told = json.loads((RESULTS.parents[1] / "docs" / "figures" / "report.json").read_text())["lines"]
    fresh = json.loads((tmp_path / "report.json").read_text())["lines"]
    assert sorted(told, key=str) == sorted(fresh, key=str), "draw them again: torchdyn-plan report --out docs/figures"
