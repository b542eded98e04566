"""A box that holds the ball stays down, wherever the plan would send it."""

import pytest
import torch

from tests.tasks.trapper.crossing import make_planner, world
from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.tasks.trapper.keep import GoToAndKeep
from torchdyn_plan.tasks.trapper.wait_and_drop import DropState, WaitAndDrop

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
    with pytest.raises(InputError, match="half_width must be >= 0, got -1"):
        GoToAndKeep(radius=0.04, half_width=-1.0)


def test_a_dropping_box_follows_the_forecast_only_until_it_has_caught_the_ball():
    # The ball rests in the box, while the forecast that knows of no box has it go on through the wall.
    maneuver = WaitAndDrop.of(SCENE)
    tool = torch.tensor([[0.0, 0.0, LOW], [0.0, 0.0, LOW]])
    ball = torch.tensor([[0.02, 0.0, 0.042], [0.05, 0.0, 0.042]])
    path = ball.unsqueeze(1) + 0.004 * torch.arange(60.0)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    seen = Observation(tool_pos=tool, target_pos=ball, robot_state=tool, step_count=torch.full((2,), 50), seen=())
    plan = Plan.hold(seen, length=path.shape[1])._replace(path=path, age=torch.zeros(2, dtype=torch.int64))
    goal = maneuver(plan, seen, torch.zeros(2, dtype=torch.bool), DropState(torch.full((2,), 9), tool))[0]
    torch.testing.assert_close(goal[0, :2], tool[0, :2])
    assert goal[1, 0] > 0.03, "one that is still outside is followed"
