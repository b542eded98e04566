"""A box that holds the ball stays down, wherever the plan would send it."""

import pytest
import torch

from tests.tasks.trapper.crossing import make_planner, world
from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.tasks.trapper.keep import GoToAndKeep

SCENE = TrapperScene()
KEEP = GoToAndKeep.of(SCENE)
HIGH, LOW = 0.1, 0.006


class Planned:
    goal = torch.tensor([0.5, 0.5, SCENE.ball_radius])


def goal_of(tool, ball):
    tool, ball = torch.tensor(tool), torch.tensor(ball)
    step = torch.zeros(tool.shape[:-1], dtype=torch.int64)
    seen = Observation(tool_pos=tool, target_pos=ball, robot_state=tool, step_count=step, seen=())
    planned = Planned()
    planned.goal = Planned.goal.expand(tool.shape)
    return KEEP(planned, seen, step > 0, KEEP.start(seen))[0]


@pytest.mark.parametrize(
    ("tool", "ball", "kept"),
    [
        ((0.0, 0.0, LOW), (0.02, -0.02, 0.042), True),
        ((0.0, 0.0, LOW), (0.04, 0.0, 0.042), False),
        ((0.0, 0.0, HIGH), (0.0, 0.0, 0.042), False),
        ((0.0, 0.0, LOW), (0.0, 0.0, -0.05), False),
    ],
)
def test_it_stays_over_the_ball_that_it_holds_and_over_no_other(tool, ball, kept):
    goal = goal_of([tool, tool], [ball, ball])
    expected = torch.tensor([*tool[:2], ball[2]]) if kept else Planned.goal
    torch.testing.assert_close(goal, expected.expand(2, 3))


def test_a_planner_with_it_stays_where_its_plan_is_long_over():
    planner = make_planner(maneuver=KEEP)
    rows = world(6)
    rows.tool = rows.trace[..., -1, :].clone()
    rows.tool[:, 2], rows.velocity = LOW, torch.zeros(6, 3)
    before = rows.tool.clone()
    rows.run(planner, 40)
    torch.testing.assert_close(rows.tool[:, :2], before[:, :2], atol=1e-3, rtol=0)


def test_sizes_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="half_room must be >= 0, got -1"):
        GoToAndKeep(down_below=0.04, half_room=-1.0)
