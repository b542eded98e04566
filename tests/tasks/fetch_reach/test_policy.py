import dataclasses

import pytest
import torch

from torchdyn_plan.envs.fetch_reach.env import reach_reward
from torchdyn_plan.nets import Actor
from torchdyn_plan.tasks.fetch_reach.dher import DynamicHindsightReplayBuffer
from torchdyn_plan.tasks.fetch_reach.policy import DHER, FetchGoalTask
from torchdyn_plan.training.ddpg import DDPG
from torchdyn_plan.training.hindsight import HindsightReplayBuffer

SHORT = dataclasses.replace(DHER, iterations=2, num_envs=4, updates=2, batch=32, warmup=1, capacity=1000)


@pytest.mark.parametrize(("velocity", "kind"), [(0.02, DynamicHindsightReplayBuffer), (None, HindsightReplayBuffer)])
def test_it_learns_with_the_replay_that_its_goals_need(velocity, kind):
    ddpg = DDPG(FetchGoalTask(velocity=velocity, num_threads=1), SHORT)
    assert isinstance(ddpg.replay, kind)
    before = [value.clone() for value in ddpg.actor.body.parameters()]
    ddpg.iterate()
    figures = ddpg.iterate()
    assert figures["loss_critic"] > 0.0
    assert any(not torch.equal(old, new) for old, new in zip(before, ddpg.actor.body.parameters(), strict=True))
    batch = ddpg.replay.sample()
    expected = reach_reward(batch["next", "achieved_goal"], batch["next", "desired_goal"])
    assert torch.equal(batch["next", "reward"], expected)


def test_the_recipe_is_its_authors():
    """250,000 steps, 100,000 updates, and a penalty of 1 on the squared action beside returns in whole steps."""
    assert DHER.iterations * DHER.num_envs * 50 == 250_000
    assert DHER.iterations * DHER.updates == 100_000
    assert DHER.action_penalty / (1.0 - DHER.gamma) == pytest.approx(1.0)
    assert DHER.tau == pytest.approx(1.0 - 0.95)


@pytest.mark.parametrize("clip_return", [True, False])
def test_values_stay_within_what_returns_can_be(clip_return):
    ddpg = DDPG(FetchGoalTask(velocity=0.02, num_threads=1), dataclasses.replace(SHORT, clip_return=clip_return))
    ddpg.iterate()
    batch, last = ddpg.replay.sample(), str(len(ddpg.critic.body) - 1)
    for value in (1000.0, -1000.0):
        with torch.no_grad():
            ddpg.loss.target_value_network_params["module", "body", last, "bias"].data.fill_(value)
        target = ddpg.loss.value_estimator.value_estimate(batch, target_params=ddpg.loss._cached_target_params)
        assert bool(((target >= -50.0) & (target <= 0.0)).all()) == clip_return
        assert ((target - value).abs() < 100.0).all() != clip_return


@pytest.mark.parametrize(("velocity", "weights"), [(None, "fetch_reach"), (0.011, "dher")])
def test_the_policies_that_ship_reach_their_goals(velocity, weights):
    task = FetchGoalTask(velocity=velocity, episodes=16, num_threads=1)
    with torch.no_grad():
        score = task.score(Actor.from_pretrained(weights))
    assert score["success"] == 1.0
    assert 1 <= score["steps"] < 10
