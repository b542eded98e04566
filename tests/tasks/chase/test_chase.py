"""Chase: its world against its laws, its closed-form optimum against search, its planners against both."""

import math

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchdyn_plan.envs.chase import ChaseEnv, ChaseWorld
from torchdyn_plan.envs.chase.env import Walks
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.chase.optimum import earliest_meeting, find_truth, reach

WORLD = ChaseWorld()
TASK = load_task("chase")


def driven(env, action, steps):
    """Places and velocities ``(steps, N, 2)`` under one action."""
    td, found = env.reset(), []
    for _ in range(steps):
        td = env.step(td.set("action", action.clone()))["next"]
        found.append((td["tool_pos"], td["robot_state"][:, 2:]))
    return [torch.stack(values) for values in zip(*found, strict=True)]


@pytest.mark.parametrize("settings", [{}, {"turning": 30.0, "num_envs": 3}, {"static_target": True}])
def test_specs_hold(settings):
    check_env_specs(ChaseEnv(**{"seed": 0, **settings}))


def test_a_walker_that_is_to_rest_stands_still():
    rollout = ChaseEnv(3, seed=0, static_target=True).rollout(5, break_when_any_done=False)
    assert torch.equal(rollout["target_pos"], rollout["target_pos"][:, :1].expand(-1, 5, -1))
    assert torch.equal(rollout["goal"], rollout["target_pos"])


def test_a_base_at_full_throttle_goes_as_far_as_the_closed_form_says():
    heading = torch.nn.functional.normalize(torch.randn(5, 2, generator=torch.Generator().manual_seed(0)), dim=-1)
    # Walkers are far: nothing ends.
    env = ChaseEnv(5, seed=0, world=ChaseWorld(nearest=50.0, farthest=60.0))
    places, velocities = driven(env, heading, 150)
    expected = reach(WORLD, WORLD.control_step * torch.arange(1, 151))
    torch.testing.assert_close((places * heading).sum(-1), expected.unsqueeze(-1).expand(-1, 5), atol=1e-4, rtol=0)
    assert velocities.norm(dim=-1).max() <= WORLD.base_speed + 1e-5


def test_no_base_changes_its_velocity_faster_than_it_may():
    torch.manual_seed(0)
    rollout = ChaseEnv(16, seed=0).rollout(40, break_when_any_done=False)
    change = rollout["next", "robot_state"][..., 2:] - rollout["robot_state"][..., 2:]
    most = WORLD.base_acceleration * WORLD.control_step
    assert change.norm(dim=-1).max() <= most + 1e-6
    assert change.norm(dim=-1).max() > 0.9 * most


@pytest.mark.parametrize("turning", [0.0, 45.0])
def test_walkers_go_at_their_speed_and_turn_as_they_should(turning):
    walks = Walks.draw(WORLD, torch.arange(40), speed=1.2, turning=turning, split="dev", seed=0)
    time = 0.01 * torch.arange(300).expand(40, -1)
    path = walks.at(time).double()
    step = path.diff(dim=1)
    torch.testing.assert_close(step.norm(dim=-1) / 0.01, torch.full_like(step[..., 0], 1.2), atol=2e-3, rtol=0)
    angle = torch.atan2(step[..., 1], step[..., 0])
    turned = torch.remainder(angle[:, -1] - angle[:, 0] + math.pi, 2 * math.pi) - math.pi
    expected = torch.remainder(walks.turning * 2.98 + math.pi, 2 * math.pi) - math.pi
    torch.testing.assert_close(turned, expected.to(turned.dtype), atol=5e-3, rtol=0)
    away = walks.start.norm(dim=-1)
    assert away.min() >= WORLD.nearest
    assert away.max() <= WORLD.farthest
    if turning:
        assert (walks.turning < 0).any()
        assert (walks.turning > 0).any()


def test_an_episode_is_a_function_of_its_number_and_its_future_is_foretold():
    few, many = (ChaseEnv(count, turning=20.0, seed=3, split="dev") for count in (2, 7))
    one, all_of_them = (env.rollout(6, break_when_any_done=False)["target_pos"] for env in (few, many))
    assert torch.equal(one, all_of_them[:2])
    env = ChaseEnv(4, turning=20.0, seed=3, split="dev")
    td = env.reset()
    for _ in range(3):
        td = env.step(td.set("action", torch.zeros(4, 2)))["next"]
    future, rows = env.true_future(torch.tensor([1, 3]), 5), torch.tensor([1, 3])
    for step in range(5):
        td = env.step(td.set("action", torch.zeros(4, 2)))["next"]
        torch.testing.assert_close(td["target_pos"][rows], future[:, step])
    truth = find_truth(TASK.default_settings(turning=20.0), episodes=4, seed=3, split="dev")
    torch.testing.assert_close(truth.future[:, 8], td["target_pos"])


def test_nobody_can_be_met_earlier_than_the_closed_form_says_and_then_they_can():
    truth = find_truth(TASK.default_settings(speed=1.0), episodes=200, seed=0, split="dev")
    least = earliest_meeting(WORLD, truth.future)
    assert torch.equal(truth.solvable, least > 0)
    rows = truth.solvable.nonzero().squeeze(-1)
    place = truth.future[rows, least[rows]]
    # Straight there at full speed from the first step on: one step earlier is too early.
    env = ChaseEnv(200, seed=0, split="dev")
    td = env.reset()
    action = torch.zeros(200, 2)
    action[rows] = torch.nn.functional.normalize(place, dim=-1)
    first = torch.full((200,), -1)
    for step in range(1, WORLD.max_steps + 1):
        td = env.step(td.set("action", action.clone()))["next"]
        near = (env.tool_pos - env.target_pos).norm(dim=-1) <= WORLD.radius + 1e-4
        first = torch.where((first < 0) & near, step, first)
    assert (first[rows] == least[rows]).float().mean() > 0.95
    assert (first[rows] <= least[rows]).all()
    assert (first[rows] >= least[rows] - 1).all()


def test_the_planner_as_it_comes_is_nearly_the_best_that_there_is():
    found = evaluate(TASK, ["meet", "pursuit"], episodes=60, split="dev", num_envs=60, progress=False)
    meet, pursuit = found.rows
    assert meet.success >= 0.99 * meet.solvable
    assert found.outcomes["meet"].success.sum() >= 0.99 * found.outcomes["meet"].solvable.sum()
    assert 1.0 <= meet.measures["time_by_least"] <= 1.02
    assert pursuit.measures["time_by_least"] > meet.measures["time_by_least"] + 0.1


def test_its_picture_shows_base_and_walker():
    env = ChaseEnv(2, seed=0, render_mode="rgb_array")
    env.reset()
    picture = env.render(row=1, width=160, height=120)
    assert picture.shape == (120, 160, 3)
    red, blue = picture[..., 0].astype(int), picture[..., 2].astype(int)
    assert (blue - red > 60).any()
    assert (red - blue > 60).any()


@pytest.mark.parametrize("change", [{"radius": 0.0}, {"farthest": 1.0}, {"base_speed": -1.0}, {"max_steps": 0}])
def test_a_world_that_is_none_is_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        ChaseWorld(**change)


def test_its_digest_tells_worlds_apart():
    assert ChaseWorld().digest() == TASK.digest() == ChaseEnv().scene_digest
    assert ChaseWorld(radius=0.4).digest() != TASK.digest()
