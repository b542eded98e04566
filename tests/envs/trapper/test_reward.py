"""The reward of reaching a goal: its laws, and that step and hindsight agree."""

import math

import pytest
import torch
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.trapper.goal_env import TrapperGoalEnv
from torchdyn_plan.envs.trapper.keys import TOOL_ROTATION
from torchdyn_plan.envs.trapper.reward import GoalReward, goal_reward, resting_ball
from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.errors import InputError
from torchdyn_plan.tasks.trapper.policy import TrapperGoalTask

SCENE, WEIGHTS = TrapperScene(), GoalReward()
DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
TABLE = torch.tensor([0.1, -0.3, SCENE.ball_radius])


def tilted(angle: float) -> Tensor:
    """A box mouth down, tilted by ``angle`` [rad] about x."""
    turn = torch.eye(3)
    turn[1, 1] = turn[2, 2] = math.cos(angle)
    turn[1, 2], turn[2, 1] = -math.sin(angle), math.sin(angle)
    return turn @ DOWN


def value(tool: Tensor, rotation: Tensor, goal: Tensor, weights: GoalReward = WEIGHTS) -> float:
    return float(goal_reward(SCENE, weights, tool, rotation, goal))


def test_box_over_a_ball_at_the_goal_has_reached_it() -> None:
    over = TABLE.clone()
    over[2] = 0.006
    beta = WEIGHTS.alignment / (1 + (0.036 / WEIGHTS.alignment_range) ** 2)
    assert value(over, DOWN, TABLE) == pytest.approx(1.0 + beta, abs=1e-5)


def test_box_off_the_middle_has_not_reached_it() -> None:
    aside = TABLE + torch.tensor([0.012, 0.0, 0.006 - SCENE.ball_radius])
    assert 0.0 < value(aside, DOWN, TABLE) < WEIGHTS.alignment


def test_box_above_waits_at_a_goal_above_only() -> None:
    above = torch.tensor([0.1, -0.3, 0.12])
    assert value(above, DOWN, above) == pytest.approx(1.0 + WEIGHTS.alignment, abs=1e-5)
    assert value(above, DOWN, TABLE) < WEIGHTS.alignment
    assert value(above + torch.tensor([0.011, 0.0, 0.0]), DOWN, above) < WEIGHTS.alignment
    assert value(above, tilted(0.5), above) < WEIGHTS.alignment


def test_low_box_beside_a_ball_at_the_goal_costs() -> None:
    beside = TABLE + torch.tensor([0.08, 0.0, -0.03])
    free = GoalReward(touch=0.0)
    assert value(beside, DOWN, TABLE) == pytest.approx(value(beside, DOWN, TABLE, free) - WEIGHTS.touch, abs=1e-6)
    high = TABLE + torch.tensor([0.08, 0.0, 0.06])
    assert value(high, DOWN, TABLE) == pytest.approx(value(high, DOWN, TABLE, free), abs=1e-6)


def test_alignment_is_worth_more_nearer_and_more_upright() -> None:
    goal = torch.tensor([0.0, -0.2, 0.15])
    near, far = (goal + torch.tensor([offset, 0.0, 0.0]) for offset in (0.05, 0.5))
    values = [value(near, tilted(angle), goal) for angle in (0.0, 0.3, 0.6, 0.9)]
    assert values == sorted(values, reverse=True)
    assert values[-1] < 0.0, "a tilted box near the goal costs"
    assert value(near, DOWN, goal) > value(far, DOWN, goal) > 0.0


def test_one_value_a_row_whatever_the_batch() -> None:
    draw = torch.Generator().manual_seed(0)
    tool, goal = torch.rand(2, 50, 3, generator=draw) * 0.1
    rotation = torch.linalg.qr(torch.randn(50, 3, 3, generator=draw))[0]
    whole = goal_reward(SCENE, WEIGHTS, tool, rotation, goal)
    rows = [goal_reward(SCENE, WEIGHTS, *row) for row in zip(tool, rotation, goal, strict=True)]
    torch.testing.assert_close(whole, torch.stack(rows))
    assert goal_reward(SCENE, WEIGHTS, *(x.view(5, 10, *x.shape[1:]) for x in (tool, rotation, goal))).shape == (
        5,
        10,
        1,
    )


def test_step_and_hindsight_agree_on_real_rollouts() -> None:
    """Every reward of a rollout is what the task computes from the stored transition, to the last bit."""
    task = TrapperGoalTask(num_threads=1)
    env = TrapperGoalEnv(16, seed=3, max_steps=40, num_threads=1)
    torch.manual_seed(0)
    rollout = env.rollout(40, break_when_any_done=False)
    flat = rollout.reshape(-1)
    assert len(flat["next", "reward"].unique()) > 500
    assert torch.equal(task.reward(flat), flat["next", "reward"])
    shuffled = flat[torch.randperm(len(flat))]
    assert torch.equal(task.reward(shuffled), shuffled["next", "reward"])


def test_a_changed_goal_is_shown_before_it_is_paid_for() -> None:
    """What a policy is shown is what it is paid for, and what it will be shown next is in ``next``."""
    env = TrapperGoalEnv(8, seed=1, max_steps=60, period=5, num_threads=1)
    rollout = env.rollout(60, break_when_any_done=False)
    goal, after = rollout[keys.DESIRED_GOAL], rollout["next", keys.DESIRED_GOAL]
    assert torch.equal(after[:, :-1], goal[:, 1:])
    tool = rollout["next", keys.TOOL_POS], rollout["next", TOOL_ROTATION]
    assert torch.equal(rollout["next", "reward"], goal_reward(SCENE, GoalReward(), *tool, goal))
    assert not torch.equal(rollout["next", "reward"], goal_reward(SCENE, GoalReward(), *tool, after))
    changes = (goal[:, 1:] != goal[:, :-1]).any(-1)
    assert changes.any(-1).all()
    low = goal[..., 2] == SCENE.ball_radius
    assert low.any()
    assert (goal[~low][:, 2] > 0.09).all()


def test_goals_do_not_depend_on_the_batch() -> None:
    goals = []
    for count in (2, 4):
        env = TrapperGoalEnv(count, seed=5, max_steps=30, num_threads=1)
        goals.append(env.rollout(30, break_when_any_done=False)[keys.DESIRED_GOAL][:2])
    assert torch.equal(*goals)


def test_resting_ball_lies_on_the_table() -> None:
    assert torch.equal(resting_ball(SCENE, torch.tensor([0.1, 0.2, 0.5])), torch.tensor([0.1, 0.2, SCENE.ball_radius]))


@pytest.mark.parametrize(("name", "number"), [("touch", -1.0), ("alignment", float("nan")), ("tolerance", 0.0)])
def test_refuses_impossible_weights(name: str, number: float) -> None:
    with pytest.raises(InputError, match=name):
        GoalReward(**{name: number})
