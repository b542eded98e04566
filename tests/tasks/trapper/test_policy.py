"""Trapper's resting balls as a policy's training sees them."""

import torch

from torchdyn_plan.nets import Actor
from torchdyn_plan.tasks.trapper.policy import TrapperGoalTask
from torchdyn_plan.tasks.trapper.task import TASK, PolicyOptions


def test_the_policy_that_ships_traps_what_it_can_reach():
    task = TrapperGoalTask(episodes=24, num_threads=1)
    with torch.no_grad():
        score = task.score(Actor.from_pretrained("trapper"))
    assert score["success"] > 0.9
    assert 20 < score["steps"] < 200


def test_an_action_holds_as_long_as_the_options_say():
    task = TASK.policies["policy"].goal_task(PolicyOptions(period=10), num_threads=1)
    assert (task.period, task.length) == (10, 50)
    assert task.settings()["period"] == 10
    env = task.make_env(2, seed=3)
    assert (env.period, env.max_steps, env.split) == (10, 50, "train")
