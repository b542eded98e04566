import dataclasses
import math

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchdyn_plan import keys
from torchdyn_plan.envs import TrapperEnv, TrapperGoalEnv, TrapperScene
from torchdyn_plan.envs.trapper.env import HOLD_STEPS, LAST_HOLD_STEPS
from torchdyn_plan.envs.trapper.keys import KEYS, TOOL_ROTATION
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.planners import IKPlanner, TargetPursuit
from torchdyn_plan.tasks.trapper.approach import BoxApproach
from torchdyn_plan.tasks.trapper.task import ik_planner

SCENE = TrapperScene()
SIZES = {"D": 3, "N": 6, "A": 6, "H": 24, "S": 15}


def straight_down():
    """A static planner that takes no goal for one on the table: it lowers the box at once."""
    approach = dataclasses.replace(BoxApproach.of(SCENE), on_table_below=0.0, clear_height=0.0)
    return IKPlanner(Arm.ur5(tool_length=SCENE.tool_length), approach=approach)


def make_env(num_envs=2, **settings):
    return TrapperEnv(num_envs, **{"num_threads": 1, "seed": 0, **settings})


@pytest.mark.parametrize("settings", [{}, {"static_target": True, "history": 5, "num_envs": 1}])
def test_specs_hold(settings):
    check_env_specs(make_env(**settings))


@pytest.mark.parametrize("static", [False, True])
def test_a_rollout_has_the_entries_of_the_table_in_their_shapes(static):
    rollout = make_env(3, static_target=static).rollout(4)
    table = (*keys.KEYS, *KEYS)
    for key in table:
        if key.writer == "env" or key.name == keys.ACTION or (static and key.name == keys.GOAL):
            shape = tuple(SIZES[size] if isinstance(size, str) else size for size in key.shape)
            assert rollout[key.name].shape == (3, 4, *shape), key
            if key.name != keys.ACTION:
                assert rollout["next", key.name].shape == (3, 4, *shape), key
    known = {key.name for key in table} | {"next", "done", "terminated", "truncated"}
    assert set(rollout.keys()) <= known


def test_equal_names_hold_equal_things():
    step = make_env(3).rollout(4)["next"]
    assert torch.equal(step["observation"], step["robot_state"])
    assert torch.equal(step["achieved_goal"], step["tool_pos"])
    assert torch.equal(step["desired_goal"], step["target_pos"])
    assert torch.equal(step["target_history"][..., -1, :], step["target_pos"])
    state = torch.cat([step[key] for key in ("joint_pos", "joint_vel", "tool_pos")], dim=-1)
    assert torch.equal(step["robot_state"], state)
    tool = Arm.ur5(tool_length=SCENE.tool_length)(step["joint_pos"])[..., :3, 3] + torch.tensor(SCENE.base_pos)
    torch.testing.assert_close(step["tool_pos"], tool, atol=1e-6, rtol=0)


def test_history_is_padded_with_the_first_sample_and_slides():
    rollout = make_env(2, history=5).rollout(12)
    path = torch.cat([rollout["target_pos"], rollout["next", "target_pos"][:, -1:]], dim=1)
    for step in range(12):
        index = (torch.arange(5) + step - 4).clamp_min(0)
        assert torch.equal(rollout["target_history"][:, step], path[:, index])
        assert rollout["history_length"][:, step].tolist() == [min(step + 1, 5)] * 2
        assert rollout["step_count"][:, step].tolist() == [[step]] * 2


def test_truncation_comes_at_the_last_step_and_not_before():
    rollout = make_env(2, max_steps=7).rollout(20, break_when_any_done=True)
    assert rollout["next", "truncated"].squeeze(-1).tolist() == [[False] * 6 + [True]] * 2
    assert not rollout["next", "terminated"].any()
    assert torch.equal(rollout["next", "done"], rollout["next", "truncated"])


def test_a_ball_that_is_uncovered_again_starts_its_time_over():
    env = make_env(1, static_target=True)
    td = env.reset()
    tool = td["tool_pos"].clone()

    def put_ball(place):
        env.simulation.ball_pos[0] = torch.cat([place[:2], torch.tensor([SCENE.ball_radius])]).double()
        env.simulation.ball_vel.zero_()

    planner = straight_down()
    away = tool[0] + torch.tensor([0.3, 0.3, 0.0])
    put_ball(away)
    goal = torch.cat([tool[:, :2], torch.tensor([[0.01]])], dim=-1)
    for _ in range(150):
        td = env.step_mdp(env.step(planner(td.set("goal", goal))))
    for step in range(2 * HOLD_STEPS - 1):
        put_ball(td["tool_pos"][0] if step != HOLD_STEPS - 1 else away)
        td = env.step_mdp(env.step(planner(td.set("goal", goal))))
        assert not td["trapped"].any()
    put_ball(td["tool_pos"][0])
    assert bool(env.step(planner(td.set("goal", goal)))["next", "trapped"])


def test_at_the_end_of_an_episode_a_ball_need_not_be_covered_so_long():
    steps = {}
    for held in (LAST_HOLD_STEPS - 1, LAST_HOLD_STEPS):
        env = make_env(1, static_target=True, max_steps=150 + held)
        td, planner = env.reset(), straight_down()
        goal = torch.cat([td["tool_pos"][:, :2], torch.tensor([[0.01]])], dim=-1)
        for step in range(150 + held):
            away = td["tool_pos"][0, :2] + 0.3 * (step < 150)
            env.simulation.ball_pos[0] = torch.cat([away, torch.tensor([SCENE.ball_radius])]).double()
            env.simulation.ball_vel.zero_()
            td = env.step_mdp(env.step(planner(td.set("goal", goal))))
            assert not td["trapped"].any() or step == 150 + held - 1
        steps[held] = bool(td["trapped"])
    assert steps == {LAST_HOLD_STEPS - 1: False, LAST_HOLD_STEPS: True}


def test_the_true_future_is_where_the_balls_go_while_the_arms_stand_still():
    env = make_env(3, velocity=3.0, num_threads=1)
    td = env.reset()
    for _ in range(20):
        td = env.step(td.set("action", torch.zeros(3, 6)))["next"]
    before = env.simulation.qpos.clone()
    future = env.true_future(torch.tensor([0, 2]), 150)
    assert torch.equal(env.simulation.qpos, before)
    path = []
    for _ in range(150):
        td = env.step(td.set("action", torch.zeros(3, 6)))["next"]
        path.append(td["target_pos"][[0, 2]])
    torch.testing.assert_close(future, torch.stack(path, dim=1), atol=1e-3, rtol=0)


def test_the_true_future_holds_arms_that_move_and_lets_balls_bounce_off_them():
    env = make_env(1, velocity=0.0, static_target=True, num_threads=1)
    td, planner = env.reset(), straight_down()
    goal = torch.cat([td["tool_pos"][:, :2], torch.tensor([[0.01]])], dim=-1)
    for _ in range(150):
        td = env.step_mdp(env.step(planner(td.set("goal", goal))))
    tool = td["tool_pos"][0, :2].double()
    start = tool + torch.tensor([SCENE.box_outer + SCENE.ball_radius + 0.1, 0.0])
    env.simulation.ball_pos[0, :2], env.simulation.ball_pos[0, 2] = start, SCENE.ball_radius
    env.simulation.ball_vel[0] = torch.tensor([-1.0, 0.0, 0.0])
    env.simulation.joint_vel[:] = 1.0
    x = env.true_future(torch.tensor([0]), 100)[0, :, 0]
    assert x.min() > tool[0] + SCENE.box_outer + 0.7 * SCENE.ball_radius
    assert x[-1] > x.min() + 0.01, "it came back"


def test_a_ball_pushed_along_by_the_box_is_no_success():
    env = make_env(1, static_target=True)
    td = env.reset()
    start = td["tool_pos"][0].clone()
    beside = start[:2] + torch.tensor([SCENE.box_outer + SCENE.ball_radius + 0.02, 0.0])
    env.simulation.reset(torch.arange(1), beside.double().unsqueeze(0), torch.zeros(1, 2, dtype=torch.float64))
    planner = straight_down()
    low = torch.tensor([[float(start[0]), float(start[1]), 0.01]])
    touched = False
    for step in range(260):
        goal = low if step < 120 else low + torch.tensor([[min(0.002 * (step - 120), 0.2), 0.0, 0.0]])
        td = env.step_mdp(env.step(planner(td.set("goal", goal))))
        assert not td["trapped"].any()
        assert not td["done"].any()
        offset = (td["target_pos"] - td["tool_pos"])[0, 0]
        touched |= bool(offset < SCENE.box_outer + SCENE.ball_radius + 0.002) and bool(td["tool_pos"][0, 2] < 0.02)
    assert touched
    assert (td["target_pos"][0, :2] - beside).norm() > 0.1


def test_a_pocketed_ball_ends_its_episode():
    env = make_env(2)
    td = env.reset()
    place = torch.tensor([[SCENE.pocket_offset, SCENE.half_side - 0.1], [0.0, 0.3]], dtype=torch.float64)
    env.simulation.reset(torch.arange(2), place, torch.tensor([[0.0, 1.5], [0.0, 0.0]], dtype=torch.float64))
    for _ in range(150):
        td = env.step(td.set("action", torch.zeros(2, 6)))["next"]
        if td["done"].any():
            break
    for key in ("pocketed", "terminated", "done"):
        assert td[key].squeeze(-1).tolist() == [True, False], key
    assert not td["truncated"].any()
    assert not td["reward"].any()
    assert float(td["target_pos"][0, 2]) < -SCENE.ball_radius


def test_a_static_ball_stays_and_is_the_goal():
    rollout = make_env(4, static_target=True).rollout(50, break_when_any_done=False)
    assert torch.equal(rollout["goal"], rollout["target_pos"])
    path = rollout["next", "target_pos"]
    assert (path - path[:, :1])[..., :2].abs().max() < 1e-4


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"velocity": -1.0}, "velocity must be in"),
        ({"velocity": math.nan}, "velocity must be a finite number"),
        ({"friction": -0.1}, "friction must be >= 0"),
        ({"friction": math.nan}, "friction must be a finite number"),
        ({"split": "tset"}, "unknown split 'tset'"),
        ({"num_envs": 0}, "num_envs must be >= 1"),
        ({"num_envs": 1.5}, "num_envs must be an integer"),
        ({"history": 1}, "history must be >= 2"),
        ({"max_steps": 0}, "max_steps must be >= 1"),
        ({"seed": -1}, "seed must be >= 0"),
    ],
)
def test_bad_settings_are_refused_by_name(setting, message):
    with pytest.raises(InputError, match=message):
        make_env(**setting)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_an_action_that_is_no_number_is_refused_and_moves_nothing(bad):
    env = make_env(2)
    td = env.reset()
    before = env.simulation.joint_pos.clone()
    action = torch.zeros(2, 6)
    action[1, 3] = bad
    with pytest.raises(InputError, match="action must be finite, got 1 NaN"):
        env.step(td.set("action", action))
    assert torch.equal(env.simulation.joint_pos, before)


@pytest.mark.parametrize("shape", [(2, 5), (2, 6, 1)])
def test_an_action_of_another_shape_is_refused(shape):
    env = make_env(2)
    with pytest.raises(InputError, match=r"action must have shape \(\*B, 2, 6\)"):
        env.step(env.reset().set("action", torch.zeros(shape)))


def test_a_start_before_the_first_episode_is_refused():
    with pytest.raises(InputError, match="episode must be >= 0"):
        make_env().start_from(-1)


def test_a_planner_of_another_scene_is_refused_before_anything_moves():
    other = TrapperScene(table_side=1.4)
    env, planner = TrapperEnv(2, scene=other, seed=0, num_threads=1), TargetPursuit(ik_planner(), scene=SCENE.digest())
    for call in (lambda: env.check_planner(planner), lambda: env.rollout(3, planner)):
        with pytest.raises(InputError, match=f"belongs to scene {SCENE.digest()}.*scene is {other.digest()}"):
            call()
    assert env.next_episode == 0


def test_planners_of_this_scene_of_none_and_plain_functions_are_taken():
    env = make_env()
    for scene in (SCENE.digest(), None):
        assert env.rollout(2, TargetPursuit(ik_planner(), scene=scene)).shape == (2, 2)
    assert env.rollout(2, lambda td: td.set("action", torch.zeros(2, 6))).shape == (2, 2)


def test_the_goal_environment_shows_the_rotation_of_the_tool():
    rollout = TrapperGoalEnv(2, max_steps=4, num_threads=1).rollout(3)
    rotation = rollout["next", TOOL_ROTATION]
    assert rotation.shape == (2, 3, 3, 3)
    torch.testing.assert_close(rotation.mT @ rotation, torch.eye(3).expand_as(rotation), atol=1e-5, rtol=0)
