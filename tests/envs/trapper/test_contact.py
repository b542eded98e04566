import math

import pytest
import torch

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.envs.trapper.contact import SLACK, is_covered, is_pocketed, is_reached, is_touched

SCENE = TrapperScene()
RADIUS = SCENE.ball_radius
ROOM = SCENE.box_half_width - RADIUS + SLACK
DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


def rotation(yaw=0.0, tilt=0.0):
    """A box mouth down, turned about the vertical and then tilted about the world's x axis."""
    c, s, ct, st = math.cos(yaw), math.sin(yaw), math.cos(tilt), math.sin(tilt)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    lean = torch.tensor([[1.0, 0.0, 0.0], [0.0, ct, -st], [0.0, st, ct]])
    return lean @ turn @ DOWN


def covered(offset, height=0.006, **turned):
    ball = torch.tensor([0.3, -0.2, RADIUS])
    tool = ball + torch.tensor([*offset, height - RADIUS])
    return bool(is_covered(SCENE, tool, rotation(**turned), ball))


@pytest.mark.parametrize(
    ("offset", "expected"),
    [((0, 0), True), ((ROOM - 1e-3, 0), True), ((ROOM + 1e-3, 0), False), ((0, -ROOM - 1e-3), False)],
)
def test_a_ball_is_covered_between_the_walls_alone(offset, expected):
    assert covered(offset) is expected


def test_room_is_measured_along_the_boxs_own_axes():
    along_diagonal = (0.95 * ROOM, 0.95 * ROOM)
    assert covered(along_diagonal)
    assert not covered(along_diagonal, yaw=math.pi / 4)
    assert covered((1.2 * ROOM * math.cos(0.7), 1.2 * ROOM * math.sin(0.7)), yaw=0.0)
    assert not covered((1.2 * ROOM * math.cos(0.7), 1.2 * ROOM * math.sin(0.7)), yaw=0.7)


@pytest.mark.parametrize(("height", "expected"), [(0.0, True), (RADIUS - 1e-3, True), (RADIUS + 1e-3, False)])
def test_the_rim_must_be_below_the_balls_centre(height, expected):
    assert covered((0, 0), height) is expected


def test_a_tilted_box_leaves_a_gap():
    below = 0.005
    assert covered((0, 0), RADIUS - below, tilt=0.9 * below / SCENE.box_outer)
    assert not covered((0, 0), RADIUS - below, tilt=1.1 * below / SCENE.box_outer)


def test_a_ball_in_a_pocket_is_not_covered_but_pocketed():
    ball = torch.tensor([[0.0, 0.0, RADIUS], [0.0, 0.0, -RADIUS / 2], [0.0, 0.0, -1.5 * RADIUS]])
    assert is_pocketed(SCENE, ball).tolist() == [False, False, True]
    assert is_covered(SCENE, torch.zeros(3, 3), DOWN.expand(3, 3, 3), ball).tolist() == [True, False, False]


def test_a_box_touches_a_ball_from_outside_near_the_table_only():
    ball = torch.tensor([0.0, 0.0, RADIUS])
    outside = SCENE.box_outer + RADIUS
    tools = [[outside, 0.0, 0.01], [outside + 0.01, 0.0, 0.01], [outside, 0.0, 0.1], [0.0, 0.0, 0.01]]
    assert is_touched(SCENE, torch.tensor(tools), ball).tolist() == [True, False, False, False]


def test_a_goal_on_the_table_is_reached_when_a_ball_there_would_be_covered():
    goal = torch.tensor([0.1, 0.2, 0.0])
    places = [[0.0, 0.0, 0.006], [ROOM - 1e-3, 0.0, RADIUS - 1e-3], [ROOM + 1e-3, 0.0, 0.0], [0.0, 0.0, RADIUS + 1e-3]]
    tool = goal + torch.tensor(places)
    assert is_reached(SCENE, tool, goal.expand(4, 3)).tolist() == [True, True, False, False]
    ball = goal + torch.tensor([0.0, 0.0, RADIUS])
    assert torch.equal(is_reached(SCENE, tool, goal.expand(4, 3)), is_covered(SCENE, tool, DOWN.expand(4, 3, 3), ball))


def test_a_goal_above_the_table_is_reached_within_fifteen_millimetres():
    goal = torch.tensor([0.1, 0.2, 0.2])
    tool = goal + torch.tensor([[0.0, 0.0, 0.014], [0.0, 0.0, 0.016], [0.014, 0.0, -0.014], [0.0, 0.0, 0.0]])
    assert is_reached(SCENE, tool, goal.expand(4, 3)).tolist() == [True, False, False, True]


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_batch_dimensions_are_free(batch):
    tool, ball = torch.zeros(*batch, 3), torch.zeros(*batch, 3) + RADIUS
    assert is_covered(SCENE, tool, DOWN.expand(*batch, 3, 3), ball).shape == batch
    assert is_touched(SCENE, tool, ball).shape == is_pocketed(SCENE, ball).shape == batch
    assert is_reached(SCENE, tool, ball).shape == batch
