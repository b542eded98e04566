import math

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from torchdyn_plan import keys
from torchdyn_plan.envs import DynamicReachEnv
from torchdyn_plan.envs.fetch_reach.env import STATE_SIZE, is_at, reach_reward
from torchdyn_plan.envs.fetch_reach.goal_motion import MOTIONS, goal_places
from torchdyn_plan.envs.fetch_reach.keys import KEYS
from torchdyn_plan.errors import InputError

SIZES = {"D": 3, "N": 7, "A": 4, "H": 8, "S": STATE_SIZE}
TABLE = (*keys.KEYS, *KEYS)


def make_env(num_envs=2, **settings):
    return DynamicReachEnv(num_envs, **{"num_threads": 1, "seed": 0, **settings})


def towards(td, place):
    """Actions that pull the gripper to ``place`` as hard as they may."""
    pull = (place - td["tool_pos"]) / 0.03
    td["action"] = torch.nn.functional.pad(pull, (0, 1)).clamp(-1.0, 1.0).float()
    return td


@pytest.mark.parametrize("settings", [{}, {"static_target": True, "history": 5, "num_envs": 1}, {"motion": "circle"}])
def test_specs_hold(settings):
    check_env_specs(make_env(**settings))


@pytest.mark.parametrize("static", [False, True])
def test_a_rollout_has_the_entries_of_the_table_in_their_shapes(static):
    rollout = make_env(3, static_target=static).rollout(4)
    for key in TABLE:
        if key.writer == "env" or key.name == keys.ACTION or (static and key.name == keys.GOAL):
            shape = tuple(SIZES[size] if isinstance(size, str) else size for size in key.shape)
            assert rollout[key.name].shape == (3, 4, *shape), key
    known = {key.name for key in TABLE} | {"next", "done", "terminated", "truncated"}
    assert set(rollout.keys()) <= known


def test_equal_names_hold_equal_things():
    step = make_env(3).rollout(4)["next"]
    assert torch.equal(step["observation"], step["robot_state"])
    assert torch.equal(step["achieved_goal"], step["tool_pos"])
    assert torch.equal(step["desired_goal"], step["target_pos"])
    assert torch.equal(step["target_history"][..., -1, :], step["target_pos"])
    assert torch.equal(step["robot_state"][..., :3], step["tool_pos"])


@pytest.mark.parametrize("motion", MOTIONS)
def test_goals_go_their_way_from_the_first_step_on(motion):
    env = make_env(4, motion=motion, velocity=0.011, history=5)
    rollout = env.rollout(12)
    seen = torch.cat([rollout["target_pos"], rollout["next", "target_pos"][:, -1:]], dim=1)
    moved = ~is_at(rollout["tool_pos"], rollout["target_pos"])
    for step in range(13):
        moves = moved[:, :step].sum(1)
        expected = goal_places(env._starts, moves, motion=motion, velocity=0.011)
        torch.testing.assert_close(seen[:, step], expected.float())
    for step in range(12):
        index = (torch.arange(5) + step - 4).clamp_min(0)
        assert torch.equal(rollout["target_history"][:, step], seen[:, index])
        assert rollout["history_length"][:, step].tolist() == [min(step + 1, 5)] * 4
        assert rollout["step_count"][:, step].tolist() == [[step]] * 4


def test_a_goal_waits_while_the_gripper_is_at_it_and_goes_on_when_it_leaves():
    """The order of DHER: the goal moves first, unless the gripper was at it when the step began."""
    env = make_env(1, velocity=0.004, max_steps=40)
    td, waited, reached = env.reset(), 0, False
    for step in range(40):
        before, was_there = td["target_pos"].clone(), bool(is_at(td["tool_pos"], td["target_pos"]))
        place = td["target_pos"] + (torch.tensor([0.0, 0.0, 0.1]) if waited >= 3 else torch.tensor([0.004, 0.0, 0.0]))
        stepped, td = env.step_and_maybe_reset(towards(td, place))
        after = stepped["next"]
        moved = (after["target_pos"] - before).norm().item()
        assert moved == pytest.approx(0.0 if was_there else 0.004, abs=1e-6), step
        at = is_at(after["tool_pos"], after["target_pos"])
        assert after["reward"].squeeze(-1).tolist() == (at.float() - 1.0).tolist()
        reached, waited = reached or bool(at), waited + was_there
        assert after["reached"].item() == reached
    assert waited >= 3
    assert not is_at(after["tool_pos"], after["target_pos"]).item(), "it left, and the success stays"


def test_no_episode_ends_early_and_every_one_ends():
    env = make_env(2, velocity=0.0, goal_range=0.0, max_steps=7)
    td = env.reset()
    dones = []
    for _ in range(14):
        stepped, td = env.step_and_maybe_reset(towards(td, td["target_pos"]))
        dones.append(stepped["next", "done"].all().item())
        assert not stepped["next", "terminated"].any()
    assert dones == ([False] * 6 + [True]) * 2
    assert td["episode"].tolist() == [4, 5]
    assert not td["reached"].any()
    assert stepped["next", "reached"].all()


def test_reward_is_one_function_for_step_and_hindsight():
    step = make_env(6, velocity=0.0, goal_range=0.1).rollout(30, lambda td: towards(td, td["target_pos"]))["next"]
    assert torch.equal(step["reward"], reach_reward(step["achieved_goal"], step["desired_goal"]))
    assert set(step["reward"].unique().tolist()) == {-1.0, 0.0}


@pytest.mark.parametrize(("first", "num_envs", "threads"), [(0, 16, 2), (3, 7, 1), (12, 4, 2)])
def test_the_same_actions_give_bit_identical_episodes(first, num_envs, threads):
    def wave(td):
        phase = 0.1 * td["step_count"].squeeze(-1) + td["episode"]
        td["action"] = torch.sin(phase.unsqueeze(-1) + torch.arange(4))
        return td

    whole = make_env(16, motion="random").rollout(12, wave)
    env = make_env(num_envs, motion="random", num_threads=threads)
    env.start_from(first)
    part = env.rollout(12, wave)
    for key in part.keys(include_nested=True, leaves_only=True):
        assert torch.equal(part[key], whole[key][first : first + num_envs]), key


def test_resets_of_some_rows_leave_the_others_alone():
    env = make_env(3)
    td = env.rollout(5)[:, -1]["next"].exclude("reward")
    again = env.reset(td.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    assert again["step_count"].tolist() == [[5], [0], [5]]
    assert again["episode"].tolist() == [0, 3, 2]
    assert torch.equal(again["tool_pos"][[0, 2]], td["tool_pos"][[0, 2]])


def test_a_collector_takes_it():
    collector = Collector(make_env(2, max_steps=5), None, frames_per_batch=24, total_frames=24)
    for batch in collector:
        assert batch["episode"].max() >= 4
    collector.shutdown()


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"num_envs": 0}, "num_envs"),
        ({"velocity": -0.1}, "velocity"),
        ({"velocity": math.nan}, "velocity"),
        ({"motion": "strait"}, "did you mean 'straight'"),
        ({"split": "devel"}, "devel"),
        ({"threshold": 0.0}, "threshold"),
        ({"goal_range": -1.0}, "goal_range"),
        ({"history": 1}, "history"),
        ({"seed": -1}, "seed"),
    ],
)
def test_bad_settings_are_named(settings, named):
    with pytest.raises(InputError, match=named):
        make_env(**settings)


@pytest.mark.parametrize("action", [torch.zeros(2, 3), torch.full((2, 4), math.nan)])
def test_bad_actions_are_named(action):
    env = make_env(2)
    td = env.reset()
    with pytest.raises(InputError, match="action"):
        env.step_and_maybe_reset(td.set("action", action))
