"""A flight with drag beside a solver of differential equations."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from torchdyn_plan.kinematics.flight import fly

DOWN = (0.0, 0.0, -9.81)
START = torch.tensor([0.3, -0.2, 1.5], dtype=torch.float64)


def solved(velocity, drag, times):
    """Places and velocities (T, 6) by Runge-Kutta of eighth order, steps as small as it takes."""

    def law(_, state):
        speed = np.linalg.norm(state[3:])
        return np.concatenate([state[3:], np.array(DOWN) - drag * speed * state[3:]])

    begin = np.concatenate([START.numpy(), velocity.numpy()])
    return torch.from_numpy(solve_ivp(law, (0.0, times[-1]), begin, "DOP853", times, rtol=1e-12, atol=1e-12).y.T.copy())


@pytest.mark.parametrize(
    ("speed", "drag", "near"), [(6.0, 0.0195, 1e-6), (20.0, 0.2, 3e-3), (40.0, 0.0, 1e-9)], ids=["ball", "cock", "none"]
)
def test_it_is_the_solution_of_its_equation(speed, drag, near):
    velocity = speed * torch.tensor([-0.8, 0.1, 0.6], dtype=torch.float64)
    place, moved = fly(START, velocity, step=0.008, count=110, gravity=DOWN, drag=drag)
    wanted = solved(velocity, drag, 0.008 * np.arange(1, 111))
    torch.testing.assert_close(place, wanted[:, :3], rtol=0.0, atol=near)
    torch.testing.assert_close(moved, wanted[:, 3:], rtol=0.0, atol=200 * near)


def test_in_the_end_a_ball_falls_as_fast_as_the_air_lets_it():
    _, velocity = fly(START, torch.zeros_like(START), step=0.01, count=1000, gravity=DOWN, drag=0.1)
    torch.testing.assert_close(velocity[-1], torch.tensor([0.0, 0.0, -((9.81 / 0.1) ** 0.5)], dtype=torch.float64))


@pytest.mark.parametrize("coordinates", [2, 3])
def test_a_batch_is_its_rows(coordinates):
    draw = torch.Generator().manual_seed(0)
    place, velocity = 3.0 * torch.randn(2, 2, 3, coordinates, generator=draw)
    how = {"step": 0.01, "count": 40, "gravity": DOWN[-coordinates:], "drag": 0.02}
    whole, speed = fly(place, velocity, **how)
    assert whole.shape == speed.shape == (2, 3, 40, coordinates)
    row, _ = fly(place[1, 2], velocity[1, 2], **how)
    torch.testing.assert_close(whole[1, 2], row)


@pytest.mark.parametrize("velocity", [(3.0, -1.0, 2.0), (0.0, 0.0, 0.0)], ids=["flies", "rests"])
def test_it_has_derivatives(velocity):
    velocity = torch.tensor(velocity, dtype=torch.float64, requires_grad=True)
    place = START.clone().requires_grad_()

    def end(place, velocity):
        return fly(place, velocity, step=0.03, count=5, gravity=DOWN, drag=0.05)[0]

    assert torch.autograd.gradcheck(end, (place, velocity), atol=1e-5)
