import pytest
import torch

from torchdyn_plan.nets.eta import arrival_classes
from torchdyn_plan.nets.spread import Spread
from torchdyn_plan.planners import LostBelow
from torchdyn_plan.training.metrics import (
    arrival_errors,
    arrival_groups,
    coverage,
    forecast_errors,
    lost_accuracy,
    lost_probability,
)
from torchdyn_plan.training.windows import Windows

AHEAD = (25, 100, 300)
LOST = LostBelow(seen_below=-0.04, forecast_below=-0.01)


def windows_of(n=5):
    """Targets on straight lines along x, 0.01 m a step: full, full, padded, lost at 50 steps, still."""
    step = torch.tensor([0.01, 0.002, 0.01, 0.01, 0.0]).view(n, 1, 1) * torch.tensor([1.0, 0.0, 0.0])
    history = step * torch.arange(-23.0, 1.0).view(1, -1, 1)
    future = step * torch.arange(1.0, 301.0).view(1, -1, 1)
    recorded = torch.ones(n, 300, dtype=torch.bool)
    recorded[3, 50:] = False
    flags = torch.tensor([False, False, False, True, False])
    future[3, 50:, 2] = -0.05
    moving = torch.tensor([True, True, True, True, False])
    return Windows(history, torch.tensor([24, 24, 13, 24, 24]), future, recorded, flags, moving)


def by(rows, *names):
    return {tuple(row[name] for name in names): row for row in rows}


def test_forecast_errors_by_hand():
    windows = windows_of()
    forecast = windows.future + torch.tensor([0.3, 0.4, 0.0]) * torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0]).view(5, 1, 1)
    rows = by(forecast_errors(forecast, windows, ahead=AHEAD), "windows", "ahead")
    assert rows["full", 25]["count"] == rows["full", 300]["count"] == 2
    assert rows["full", 300]["median"] == pytest.approx(0.5)
    assert rows["full", 300]["mean"] == pytest.approx(0.75)
    assert rows["full", 300]["constant_velocity"] == pytest.approx(0.0, abs=1e-5)
    assert rows["padded", 100]["mean"] == pytest.approx(2.0)
    assert rows["fast", 100]["count"] == 2
    assert rows["lost", 25]["mean"] == pytest.approx(4.0)
    assert rows["lost", 100] == rows["lost", 100] | {"count": 0, "median": None, "mean": None}
    assert rows["still", 300]["mean"] == pytest.approx(8.0)


def test_constant_velocity_goes_on_as_in_the_last_step():
    windows = windows_of()
    windows.future[:, :, 1] += 0.2
    rows = by(forecast_errors(windows.future, windows, ahead=AHEAD), "windows", "ahead")
    assert rows["full", 100]["constant_velocity"] == pytest.approx(0.2, abs=1e-5)
    assert rows["full", 100]["median"] == 0.0


def test_short_horizons_are_scored_as_far_as_they_go():
    windows = windows_of()
    short = windows._replace(future=windows.future[:, :120], recorded=windows.recorded[:, :120])
    assert {row["ahead"] for row in forecast_errors(short.future, short, ahead=AHEAD)} == {25, 100}


def test_lost_accuracy_by_hand():
    windows = windows_of()
    assert lost_accuracy(windows.future, windows, LOST) == {"count": 4, "lost": 0.25, "found": 1.0, "false": 0.0}
    wrong = windows.future.clone()
    wrong[..., 2] *= -1
    wrong[0, -1, 2] = -1.0
    assert lost_accuracy(wrong, windows, LOST)["found"] == 0.0
    assert lost_accuracy(wrong, windows, LOST)["false"] == pytest.approx(1 / 3)


def test_arrival_errors_by_hand():
    arrival = torch.tensor([2, 7, 102, -1, -1, 900])
    logits = 20 * torch.nn.functional.one_hot(torch.tensor([0, 3, 20, 100, 5, 100]), 101).double()
    everything = torch.ones(6, dtype=torch.bool)
    rows = by(arrival_errors(logits, arrival, {"all": everything, "none": ~everything}), "samples", "estimator")
    mode = rows["all", "mode"]
    assert (mode["count"], mode["mean"], mode["p95"]) == (3, pytest.approx(10 / 3), 10.0)
    assert mode["bias"] == pytest.approx(10 / 3)
    assert mode["never_accuracy"] == pytest.approx(5 / 6)
    assert rows["all", "expectation"]["mean"] == pytest.approx(10 / 3, abs=1e-2)
    assert rows["none", "mode"]["mean"] is None
    assert rows["none", "mode"]["never_accuracy"] is None


def test_expectation_of_perfect_targets_has_no_error_and_no_bias():
    arrival = torch.arange(2, 498)
    logits = arrival_classes(arrival)[0].log()
    everything = {"all": torch.ones(496, dtype=torch.bool)}
    rows = by(arrival_errors(logits, arrival, everything), "estimator")
    assert rows[("expectation",)]["mean"] < 1e-3
    assert rows[("mode",)]["mean"] == pytest.approx(1.2, abs=0.01)


def test_arrival_groups_by_hand():
    rest = torch.tensor([True, False, True])
    groups = arrival_groups(torch.tensor([29, 30, -1]), rest)
    assert {name: mask.tolist() for name, mask in groups.items()} == {
        "all": [True, True, True],
        "soon": [True, False, False],
        "at rest": [True, False, True],
        "in motion": [False, True, False],
    }


def test_coverage_by_hand():
    windows = windows_of()
    spread = Spread(torch.full((5, 300, 2), 0.01), torch.ones(5, 300, 2), torch.zeros(5, 300))
    # Intervals of 50, 80, 90 and 95 %: 0.01, 0.04, 0.09 and 0.19 m.
    off = torch.tensor([0.05, 0.1, 0.0, 0.0, 0.0]).view(5, 1, 1) * torch.tensor([1.0, -0.09, 0.0])
    rows = by(coverage(windows.future + off, spread, windows, ahead=AHEAD, near=0.055), "windows", "ahead")
    full = rows["full", 100]
    assert full["count"] == 2
    assert [full[f"within_{share}"] for share in (50, 80, 90, 95)] == [0.5, 0.5, 0.75, 1.0]
    assert full["half_width_90"] == pytest.approx(0.09)
    assert full["near"] == 0.5
    assert full["near_predicted"] == pytest.approx((55 / 65) ** 2)
    assert rows["still", 25]["within_50"] == 1.0
    assert rows["lost", 100]["within_50"] is None


def test_probability_of_being_lost_by_hand():
    gone = torch.tensor([0.1, 0.1, 0.1, 0.6, 0.9]).unsqueeze(-1).expand(5, 300)
    rows = by(
        lost_probability(Spread(torch.ones(5, 300, 2), torch.ones(5, 300, 2), gone), windows_of(), ahead=AHEAD), "ahead"
    )
    expected = {"ahead": 25, "count": 4, "predicted": 0.225, "share": 0.0, "brier": 0.0975, "brier_share": 0.0}
    assert rows[25,] == pytest.approx(expected)
    assert rows[100,]["share"] == 0.25
    assert rows[100,]["brier"] == pytest.approx((0.03 + 0.16) / 4)
    assert rows[100,]["brier_share"] == pytest.approx(0.1875)
