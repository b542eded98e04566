import pytest

from torchdyn_plan.tasks.fetch_reach.paper import FetchReachCurves
from torchdyn_plan.tasks.fetch_reach.task import FetchReachSettings

PAPER = FetchReachCurves()


def test_points_of_the_figure_come_back():
    assert PAPER.rate("corner", "proportional", FetchReachSettings(velocity=0.031), solvable=False) == 0.618
    assert PAPER.rate("dher", "rl", FetchReachSettings(velocity=0.011), solvable=False) == 0.826
    between = PAPER.rate("dher", "rl", FetchReachSettings(velocity=0.0135), solvable=False)
    assert between == pytest.approx((0.826 + 0.546) / 2)


@pytest.mark.parametrize(
    ("planner", "settings", "solvable"),
    [("exact", {}, False), ("corner", {}, True), ("corner", {"motion": "circle"}, False)],
)
def test_nothing_is_made_up_beyond_the_paper(planner, settings, solvable):
    assert PAPER.rate(planner, "proportional", FetchReachSettings(**settings), solvable=solvable) is None
    assert PAPER.curve("corner", "proportional", "threshold", FetchReachSettings(), solvable=False) is None
    assert PAPER.rate("corner", "proportional", FetchReachSettings(velocity=0.1), solvable=False) is None
