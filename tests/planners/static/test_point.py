"""A point with limits, against a simulation of its motion and against closed forms."""

import pytest
import torch
from tensordict import TensorDict

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import PointArrival
from torchdyn_plan.planners import PointPlanner

LIMITS = {"speed": 1.5, "acceleration": 2.0, "control_step": 0.02}


def moved(place, velocity, action):
    """One control step of a point that turns its velocity towards what it is told as fast as it may."""
    change = LIMITS["speed"] * action - velocity
    most = LIMITS["acceleration"] * LIMITS["control_step"]
    change = change * (most / change.norm(dim=-1, keepdim=True).clamp_min(1e-12)).clamp(max=1.0)
    return place + LIMITS["control_step"] * (velocity + 0.5 * change), velocity + change


def driven(planner, place, velocity, goal, steps):
    """Places and velocities ``(steps, N, D)`` on the way to a goal."""
    found = []
    for _ in range(steps):
        td = planner(TensorDict({"tool_pos": place, "goal": goal}, batch_size=place.shape[:-1]))
        place, velocity = moved(place, velocity, td["action"])
        found.append((place, velocity))
    return [torch.stack(values) for values in zip(*found, strict=True)]


def told(planner, place, velocity, goal):
    state = torch.cat([place, velocity], dim=-1).unsqueeze(-2)
    return planner.arrival_model().arrival(state, goal.unsqueeze(-2)).steps.squeeze(-1)


@pytest.mark.parametrize("size", [2, 3])
def test_from_rest_it_passes_a_place_when_the_closed_form_says(size):
    way = torch.tensor([0.1, 0.5, 0.5625, 0.6, 1.0, 4.0], dtype=torch.float64)
    heading = torch.nn.functional.normalize(torch.randn(6, size, dtype=torch.float64), dim=-1)
    goal, zero = heading * way.unsqueeze(-1), torch.zeros(6, size, dtype=torch.float64)
    planner = PointPlanner(**LIMITS, stops=False)
    # Up to v² / 2a it speeds up all the way: t = √(2 way / a); from there t = way / v + v / 2a.
    exact = torch.where(way < 0.5625, (way).sqrt(), way / 1.5 + 0.375)
    torch.testing.assert_close(told(planner, zero, zero, goal), exact / 0.02, atol=1e-4, rtol=0)
    places, _ = driven(planner, zero, zero, goal, 200)
    passed = ((places * heading).sum(-1) >= way - 1e-9).int().argmax(0) + 1
    assert ((passed - exact / 0.02) >= -1e-6).all()
    assert ((passed - exact / 0.02) <= 1.0 + 1e-6).all()


@pytest.mark.parametrize("stops", [True, False])
def test_it_is_there_when_it_says_whatever_its_velocity(stops):
    torch.manual_seed(0)
    place, goal = torch.zeros(200, 2, dtype=torch.float64), 3.0 * torch.randn(200, 2, dtype=torch.float64)
    velocity = 1.5 * torch.nn.functional.normalize(torch.randn_like(goal), dim=-1) * torch.rand(200, 1).double()
    planner = PointPlanner(**LIMITS, stops=stops, radius=0.05)
    places, _ = driven(planner, place, velocity, goal, 600)
    there = (places - goal).norm(dim=-1) <= 0.05
    assert there.any(0).all()
    count = there.int().argmax(0) + 1
    error = count - told(planner, place, velocity, goal)
    # One that stops is within its radius a little before it rests; across its way it is told nearly.
    assert error.abs().median() < (16.0 if stops else 1.5)
    assert error.abs().quantile(0.9) < 25.0


def test_it_stops_at_its_goal_and_goes_no_faster_than_it_may():
    torch.manual_seed(0)
    goal = torch.randn(50, 3)
    places, velocities = driven(PointPlanner(**LIMITS), torch.zeros(50, 3), torch.zeros(50, 3), goal, 400)
    torch.testing.assert_close(places[-1], goal, atol=1e-3, rtol=0)
    assert velocities[-1].norm(dim=-1).max() < 1e-2
    assert velocities.norm(dim=-1).max() <= 1.5 + 1e-4
    # It does not swing to and fro: once it is near, it stays.
    far = (places - goal).norm(dim=-1)
    assert (far.gather(0, (far < 0.005).int().argmax(0)[None]) < 0.005).all()
    assert (far[(far < 0.005).int().cumsum(0) > 0] < 0.005).all()


def test_at_its_goal_it_stands_still_also_in_the_gradient():
    goal = torch.zeros(4, 2, requires_grad=True)
    td = PointPlanner(**LIMITS)(TensorDict({"tool_pos": torch.zeros(4, 2), "goal": goal}, batch_size=[4]))
    assert not td["action"].any()
    arrival = PointArrival(**LIMITS, stops=False, radius=0.1).arrival(torch.zeros(4, 1, 4), goal.unsqueeze(-2))
    assert not arrival.steps.any()
    arrival.steps.sum().backward()
    assert goal.grad.isfinite().all()


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_a_batch_is_its_rows(batch):
    torch.manual_seed(0)
    state, goal = torch.randn(*batch, 1, 6), torch.randn(*batch, 5, 3)
    for stops in (True, False):
        model = PointArrival(**LIMITS, stops=stops)
        steps = model.arrival(state, goal).steps
        rows = [model.arrival(s, g).steps for s, g in zip(state.view(-1, 1, 6), goal.view(-1, 5, 3), strict=True)]
        torch.testing.assert_close(steps, torch.stack(rows).view(steps.shape))


@pytest.mark.parametrize("name", ["speed", "acceleration", "control_step"])
def test_a_limit_that_is_none_is_named(name):
    with pytest.raises(InputError, match=f"{name} must be"):
        PointPlanner(**{**LIMITS, name: 0.0})


def test_a_state_without_velocity_is_named():
    with pytest.raises(InputError, match="robot_state must begin with position and velocity, 6 numbers, got 3"):
        PointArrival(**LIMITS).arrival(torch.zeros(2, 1, 3), torch.zeros(2, 4, 3))
