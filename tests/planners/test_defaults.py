"""A planner as it comes, and the paper's by name."""

import pytest
import torch

from tests.envs.points import STRIDE, PointEnv
from tests.planners.toy import Straight, StraightArrival, go_straight
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.nets import AnalyticArrival, ConstantVelocity, PointArrival
from torchdyn_plan.planners import (
    CallablePlanner,
    CornerSearch,
    DynamicPlanner,
    ExactSearch,
    IKPlanner,
    PointPlanner,
    ProportionalController,
    ReplanSchedule,
    TargetPursuit,
)

STEP = 0.05
"""A control step of `PointEnv` [s]: its points have no inertia, and go one stride in it."""


class Quick(PointEnv):
    """Targets that are faster than the points that run after them, and cross their way."""

    def __init__(self, num_envs=64, **series):
        super().__init__(num_envs, speed=0.12, max_steps=60, **series)

    def _start(self, rows, episodes):
        place = super()._start(rows, episodes)
        place[:, 0] = -2.0 + 0.3 * place[:, 0]
        place[:, 1] = 1.5 + 0.3 * place[:, 1]
        self.target[rows] = place
        return place

    def _flags(self):
        return super()._flags() | {"gone": self.target_pos[:, 0] > 3.0}


def static():
    return ProportionalController(gain=1.0 / STRIDE)


def steps(robot_state, goal):
    # Each axis is pulled on its own.
    return (goal - robot_state).abs().amax(-1) / STRIDE


def met(planner):
    rollout = Quick().rollout(60, planner, break_when_any_done=False)
    first = rollout["next", "done"].squeeze(-1).int().argmax(1)
    return rollout["next", "met"].squeeze(-1)[torch.arange(len(first)), first].float().mean().item()


def test_as_it_comes_it_beats_pursuit_and_the_papers_clock():
    ours = met(DynamicPlanner(static(), eta=steps))
    assert ours > met(TargetPursuit(static())) + 0.5
    assert ours > met(DynamicPlanner.paper(static(), ConstantVelocity(), steps)) + 0.1
    assert ours >= 0.95


def test_as_it_comes_it_looks_at_every_step_of_the_forecast_every_few_steps():
    planner = DynamicPlanner(static(), eta=steps)
    assert planner.search == ExactSearch(stride=1, first=1)
    assert planner.schedule == ReplanSchedule.every(4, first_step=1)
    assert isinstance(planner.forecaster, ConstantVelocity)
    rollout = Quick(2).rollout(12, planner)
    assert rollout["plan", "replanned"][0].nonzero().squeeze(-1).tolist() == [1, 5, 9]


def test_the_papers_configuration_has_a_name_and_any_part_of_it_can_be_another():
    paper = DynamicPlanner.paper(go_straight(), Straight(), StraightArrival())
    assert (paper.search, paper.schedule) == (CornerSearch(), ReplanSchedule())
    other = DynamicPlanner.paper(go_straight(), Straight(), StraightArrival(), search=ExactSearch())
    assert (other.search, other.schedule) == (ExactSearch(), ReplanSchedule())


def test_a_static_planner_that_knows_its_own_times_needs_no_arrival_model(tmp_path):
    arm = Arm.ur5()
    planner = DynamicPlanner(IKPlanner(arm))
    assert isinstance(planner.eta, AnalyticArrival)
    planner.save_pretrained(tmp_path)
    assert isinstance(DynamicPlanner.from_pretrained(tmp_path).eta, AnalyticArrival)
    point = PointPlanner(speed=1.0, acceleration=1.0, control_step=STEP)
    assert isinstance(DynamicPlanner(point).eta, PointArrival)


def test_an_arm_is_where_its_planner_says_when_it_says():
    arm, start = Arm.ur5(), torch.tensor([0.0, -1.2, 1.8, -2.0, -1.5, 0.0])
    planner = IKPlanner(arm)
    goal = arm(start + torch.tensor([0.6, 0.3, -0.3, 0.2, 0.0, 0.0]))[:3, 3]
    told = planner.arrival_model().arrival(torch.cat([start, 0 * start])[None, None], goal[None, None])
    q, count = start, 0
    while (arm(q)[:3, 3] - goal).norm() > 0.005 and count < 400:
        _, q = planner.step(q[None], goal[None])
        q, count = q[0], count + 1
    assert not told.never.any()
    assert abs(count - told.steps.item()) < 0.15 * count + 6


@pytest.mark.parametrize("named", [CallablePlanner(lambda state, goal: goal), lambda td: td])
def test_one_that_does_not_is_asked_for_it(named):
    with pytest.raises(InputError, match=f"eta is needed, because {type(named).__name__} has no arrival_model"):
        DynamicPlanner(named)
