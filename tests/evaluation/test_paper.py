import pytest

from torchdyn_plan.evaluation.paper import paper_curve, paper_rate, paper_rate_at


def test_points_of_the_figure_come_back():
    assert paper_rate("corner", "ik", "velocity", 3.0, solvable=False) == pytest.approx(0.438)
    assert paper_rate("pursuit", "ik", "velocity", 5.0, solvable=False) == pytest.approx(0.121)
    assert paper_rate("pursuit", "ik", "velocity", 0.0, solvable=False) == pytest.approx(0.285)
    assert paper_rate("corner", "ik", "velocity", 0.0, solvable=True) == pytest.approx(0.832)
    assert paper_rate("oracle", "rl", "velocity", 0.2, solvable=False) == pytest.approx(0.29)


def test_between_points_lies_a_straight_line():
    ends = [paper_rate("oracle", "ik", "velocity", x, solvable=True) for x in (1.0, 1.25)]
    assert paper_rate("oracle", "ik", "velocity", 1.1, solvable=True) == pytest.approx(0.6 * ends[0] + 0.4 * ends[1])


@pytest.mark.parametrize("over", ["velocity", "friction"])
@pytest.mark.parametrize("static", ["ik", "rl"])
@pytest.mark.parametrize("planner", ["corner", "pursuit", "oracle"])
def test_every_curve_of_the_paper_is_there(planner, static, over):
    for solvable in (False, True):
        xs, ys = paper_curve(planner, static, over, solvable=solvable)
        assert xs == sorted(set(xs))
        assert all(0 <= y <= 1 for y in ys)
        found = [paper_rate(planner, static, over, x, solvable=solvable) for x in xs]
        assert found == pytest.approx(ys)


def test_nothing_is_made_up_beyond_the_paper():
    assert paper_rate("corner", "ik", "velocity", 5.1, solvable=False) is None
    assert paper_rate("corner", "rl", "velocity", 0.1, solvable=False) is None
    assert paper_rate("meet", "ik", "velocity", 3.0, solvable=False) is None
    assert paper_rate("corner", "mpc", "velocity", 3.0, solvable=False) is None


def test_a_setting_finds_its_sweep():
    assert paper_rate_at("corner", "ik", 2.0, 0.0, solvable=True) == paper_rate(
        "corner", "ik", "velocity", 2.0, solvable=True
    )
    assert paper_rate_at("corner", "ik", 3.0, 5.0, solvable=True) == paper_rate(
        "corner", "ik", "friction", 5.0, solvable=True
    )
    assert paper_rate_at("corner", "ik", 2.0, 5.0, solvable=True) is None
