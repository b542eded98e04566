"""Least times of joints beside cases worked out by hand, and beside a search over all ways to drive them."""

import pytest
import torch

from torchdyn_plan.kinematics.timing import arrival_time, travel_time

SPEED, ACCELERATION = torch.tensor([2.0], dtype=torch.float64), torch.tensor([4.0], dtype=torch.float64)


def time_of(offset, velocity=0.0):
    values = torch.tensor([[offset], [velocity]], dtype=torch.float64)
    return travel_time(values[0], values[1], SPEED, ACCELERATION).item()


@pytest.mark.parametrize(
    ("offset", "velocity", "seconds"),
    [
        (0.0, 0.0, 0.0),
        # A triangle: √(d/a) up and down again.
        (0.25, 0.0, 0.5),
        (-0.25, 0.0, 0.5),
        # A trapezoid: half a second up, half a second down, a metre each second and a half between.
        (3.0, 0.0, 2.0),
        (-3.0, 0.0, 2.0),
        # It brakes, and is there.
        (0.5, 2.0, 0.5),
        (-0.5, -2.0, 0.5),
        # At full speed already.
        (2.5, 2.0, 1.5),
        # Half a second to stop half a metre away, then back.
        (0.0, 2.0, 0.5 + 2 * (0.5 / 4.0) ** 0.5),
        (-1.0, 2.0, 0.5 + 0.5 + 0.5 + 0.25),
        # Too fast: a second's braking from 4 to 0 takes 2 m; 1 m more at the limit.
        (3.0, 4.0, 1.5),
    ],
)
def test_it_is_what_is_worked_out_by_hand(offset, velocity, seconds):
    assert time_of(offset, velocity) == pytest.approx(seconds, abs=1e-6)


def test_no_way_of_driving_is_faster():
    """Bang-bang with any switching times, cut at the limit of speed: the best of a fine search is the closed form."""
    draw = torch.Generator().manual_seed(0)
    peak = torch.linspace(-2.0, 2.0, 40001, dtype=torch.float64)
    peak = peak[peak.abs() > 1e-9]
    for _ in range(20):
        offset, velocity = (torch.rand(2, generator=draw, dtype=torch.float64) * 2 - 1).tolist()
        to_peak = (peak - velocity).abs() / 4.0
        moved = 0.5 * (velocity + peak) * to_peak + 0.5 * peak * peak.abs() / 4.0
        at_peak = (offset - moved) / peak
        seconds = to_peak + peak.abs() / 4.0 + at_peak.clamp_min(0.0)
        best = seconds[at_peak >= -1e-3].min().item()
        assert time_of(offset, velocity) <= best + 1e-6
        assert time_of(offset, velocity) == pytest.approx(best, rel=0.01, abs=2e-3)


def test_joints_arrive_with_the_slowest():
    offset = torch.tensor([[0.1, -1.0, 0.5], [0.0, 0.0, 0.0]])
    limits = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([5.0, 6.0, 7.0])
    each = travel_time(offset, torch.zeros_like(offset), *limits)
    assert torch.equal(arrival_time(offset, torch.zeros_like(offset), *limits), each.amax(-1))
    assert each[0].argmax() == 1


def test_its_gradient_is_a_number_everywhere_and_right():
    offset = torch.tensor([0.3, -2.0, 0.5, -0.7, 0.1], dtype=torch.float64).unsqueeze(-1).requires_grad_()
    velocity = torch.tensor([0.2, 0.5, 1.9, 1.0, -1.0], dtype=torch.float64).unsqueeze(-1).requires_grad_()
    assert torch.autograd.gradcheck(lambda *given: travel_time(*given, SPEED, ACCELERATION), (offset, velocity))
    rest = torch.zeros(3, 1, dtype=torch.float64, requires_grad=True)
    travel_time(rest, rest, SPEED, ACCELERATION).sum().backward()
    assert rest.grad.isfinite().all()
