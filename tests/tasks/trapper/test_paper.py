import pytest

from torchdyn_plan.evaluation.curves import rate_at
from torchdyn_plan.tasks.trapper.paper import TrapperCurves
from torchdyn_plan.tasks.trapper.task import TrapperSettings

PAPER = TrapperCurves()


def rate(planner, static, *, solvable, **settings):
    return PAPER.rate(planner, static, TrapperSettings(**settings), solvable=solvable)


def test_points_of_the_figure_come_back():
    assert rate("corner", "ik", velocity=3.0, solvable=False) == pytest.approx(0.438)
    assert rate("pursuit", "ik", velocity=5.0, solvable=False) == pytest.approx(0.121)
    assert rate("pursuit", "ik", velocity=0.0, solvable=False) == pytest.approx(0.285)
    assert rate("corner", "ik", velocity=0.0, solvable=True) == pytest.approx(0.832)
    assert rate("oracle", "rl", velocity=0.2, solvable=False) == pytest.approx(0.29)


def test_between_points_lies_a_straight_line():
    ends = [rate("oracle", "ik", velocity=x, solvable=True) for x in (1.0, 1.25)]
    assert rate("oracle", "ik", velocity=1.1, solvable=True) == pytest.approx(0.6 * ends[0] + 0.4 * ends[1])
    assert rate_at(([0.0, 2.0], [0.2, 0.6]), 0.5) == pytest.approx(0.3)


@pytest.mark.parametrize("over", ["velocity", "friction"])
@pytest.mark.parametrize("static", ["ik", "rl"])
@pytest.mark.parametrize("planner", ["corner", "pursuit", "oracle"])
def test_every_curve_of_the_paper_is_there(planner, static, over):
    for solvable in (False, True):
        xs, ys = PAPER.curve(planner, static, over, TrapperSettings(), solvable=solvable)
        assert xs == sorted(set(xs))
        assert all(0 <= y <= 1 for y in ys)
        # Without friction the curve over velocities counts.
        for x, y in zip(xs, ys, strict=True):
            if over == "velocity" or x > 0:
                assert rate(planner, static, solvable=solvable, **{over: x}) == pytest.approx(y)


def test_nothing_is_made_up_beyond_the_paper():
    assert rate("corner", "ik", velocity=5.1, solvable=False) is None
    assert rate("corner", "rl", velocity=0.1, solvable=False) is None
    assert rate("wait_and_drop", "ik", velocity=3.0, solvable=False) is None
    assert rate("corner", "mpc", velocity=3.0, solvable=False) is None
    assert rate("corner", "ik", velocity=2.0, friction=5.0, solvable=True) is None
    assert PAPER.curve("corner", "ik", "velocity", TrapperSettings(friction=1.0), solvable=False) is None
    assert PAPER.curve("corner", "ik", "friction", TrapperSettings(velocity=2.0), solvable=False) is None
