import math

import pytest
import torch

from torchdyn_plan.envs.fetch_reach.goal_motion import (
    CENTRE,
    CENTRE_RANGE,
    HEIGHT,
    MOTIONS,
    RADIUS,
    draw_goals,
    goal_places,
)
from torchdyn_plan.errors import InputError

TOOL = torch.tensor([1.34, 0.75, 0.53], dtype=torch.float64)


def starts_of(motion, count=200, **settings):
    settings = {"goal_range": 0.1, "split": "dev", "seed": 0, **settings}
    return draw_goals(torch.arange(count), TOOL, motion=motion, **settings)


def path(starts, motion, steps, velocity):
    return torch.stack([goal_places(starts, torch.full((len(starts.angle),), k), motion=motion, velocity=velocity)
                        for k in range(steps)], dim=1)  # fmt: skip


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_step_is_as_long_as_the_velocity_says_and_level(motion):
    places = path(starts_of(motion), motion, 30, 0.011)
    chord = 2 * RADIUS * math.sin(0.011 / RADIUS / 2) if motion == "circle" else 0.011
    steps = places.diff(dim=1)
    torch.testing.assert_close(steps.norm(dim=-1), torch.full_like(steps[..., 0], chord))
    assert (places[..., 2] == HEIGHT).all()


def test_straight_goals_start_around_the_gripper_and_go_along_x():
    places = path(starts_of("straight"), "straight", 2, 0.02)
    away = places[:, 0] - TOOL
    assert 0.09 < away[:, :2].abs().max() <= 0.1
    assert away[:, :2].mean(0).abs().max() < 0.02
    torch.testing.assert_close(places[:, 1] - places[:, 0], torch.tensor([[0.02, 0.0, 0.0]] * 200).double())


def test_random_directions_go_all_over():
    step = path(starts_of("random"), "random", 2, 0.02).diff(dim=1)[:, 0]
    quarters = (step[:, 0] > 0).long() + 2 * (step[:, 1] > 0).long()
    assert torch.bincount(quarters, minlength=4).min() > 30


def test_circles_follow_the_formula_of_dher():
    starts = starts_of("circle")
    places = path(starts, "circle", 10, 0.011)
    assert (starts.place[:, :2] - torch.tensor(CENTRE)).abs().max() <= CENTRE_RANGE
    angle = starts.angle.clone()
    for k in range(10):
        expected = starts.place + 0.1 * torch.stack([torch.sin(angle), torch.cos(angle), 0 * angle], -1)
        torch.testing.assert_close(places[:, k], expected)
        angle += 0.11


def test_goals_at_rest_start_at_any_height():
    away = starts_of("straight", goal_range=0.15, level=False).place - TOOL
    assert (away.abs().amax(0) > 0.13).all()
    assert away.abs().max() <= 0.15


def test_a_start_is_a_function_of_split_seed_and_episode():
    three = draw_goals(torch.tensor([7, 3]), TOOL, motion="random", goal_range=0.1, split="dev", seed=0)
    for one, other in zip(three, starts_of("random"), strict=True):
        assert torch.equal(one, other[[7, 3]])
    for other in (starts_of("random", seed=1), starts_of("random", split="test")):
        assert not torch.equal(other.place, starts_of("random").place)


def test_unknown_motions_and_splits_are_named():
    with pytest.raises(InputError, match="zigzag"):
        starts_of("zigzag")
    with pytest.raises(InputError, match="devel"):
        starts_of("straight", split="devel")
