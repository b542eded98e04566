"""Conveyor: the Panda against a published description, the belt against its law, the cups' rule, the planners."""

import math

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchdyn_plan.envs import Sensor
from torchdyn_plan.envs.conveyor import ConveyorEnv, ConveyorScene, panda_arm
from torchdyn_plan.envs.conveyor.env import draw_parts
from torchdyn_plan.envs.conveyor.panda import PANDA_LINKS, TOOL_TURN
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.planners import ChoosingPlanner
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.conveyor.solvable import parts_solvable

SCENE = ConveyorScene()
TASK = load_task("conveyor")
JOINTS = [0.3, -0.5, 0.4, -2.1, 0.6, 1.7, -0.8]
PUBLISHED = [
    [0.197070018, 0.963671941, -0.180277002, 0.264468669],
    [0.924614854, -0.121551716, 0.360988298, 0.338584525],
    [0.325961315, -0.237826764, -0.914979591, 0.610946273],
    [0.0, 0.0, 0.0, 1.0],
]
"""Pose of panda_link8 at these joints by the URDF in example-robot-data 6.0.0."""


def driven(env, action, steps):
    """What is seen after each of some steps under one action, ``(steps, N, …)`` by key."""
    td, seen = env.reset(), []
    for _ in range(steps):
        td = env.step(td.set("action", action.clone()))["next"]
        seen.append(dict(td.items()))
    shown = ("tool_pos", "target_pos", "target_quat", "targets_pos", "targets_quat", "joint_pos")
    return {key: torch.stack([one[key] for one in seen]) for key in shown}


@pytest.mark.parametrize("settings", [{"parts": 2, "num_envs": 2}, {"static_target": True}])
def test_specs_hold(settings):
    check_env_specs(ConveyorEnv(seed=0, num_threads=1, **settings))


def test_its_arm_is_the_published_panda():
    pose = panda_arm(dtype=torch.float64)(torch.tensor([JOINTS], dtype=torch.float64))[0]
    c, s = math.cos(-TOOL_TURN), math.sin(-TOOL_TURN)
    back = pose.new_tensor([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    torch.testing.assert_close(pose @ back, pose.new_tensor(PUBLISHED), atol=1e-6, rtol=0)


def test_the_simulated_tool_is_where_the_arm_says():
    env = ConveyorEnv(3, seed=0, split="dev", num_threads=1)
    seen = driven(env, torch.linspace(-0.4, 0.4, 21).view(3, 7), 15)
    tool = env.simulation.model.body("tool").id
    env.simulation.batch.forward(None)
    pos = torch.from_numpy(env.simulation.batch.bind("xpos"))[:, tool]
    torch.testing.assert_close(seen["tool_pos"][-1].double(), pos, atol=1e-5, rtol=0)


def test_a_belt_carries_its_parts_at_its_speed_and_their_future_is_foretold():
    env = ConveyorEnv(4, speed=0.6, parts=2, seed=0, split="dev", num_threads=1)
    start = env.reset()
    future = env.true_future(torch.arange(4), 40)
    seen = driven(ConveyorEnv(4, speed=0.6, parts=2, seed=0, split="dev", num_threads=1), torch.zeros(4, 7), 40)
    torch.testing.assert_close(seen["target_pos"].transpose(0, 1), future, atol=1e-3, rtol=0)
    way = seen["targets_pos"][-1] - start["targets_pos"]
    torch.testing.assert_close(way, torch.tensor([0.0, 0.48, 0.0]).expand_as(way), atol=1e-3, rtol=0)
    torch.testing.assert_close(seen["targets_quat"][-1], start["targets_quat"], atol=1e-3, rtol=0)


def test_no_joint_is_told_to_be_faster_or_quicker_than_it_may_be():
    torch.manual_seed(0)
    env, told, done = ConveyorEnv(8, seed=0, num_threads=1), [], []
    td = env.reset()
    for _ in range(60):
        td = env.step(td.set("action", torch.rand(8, 7).round() * 2.0 - 1.0))["next"]
        told.append(env.simulation.told_speed.clone())
        done.append(td["joint_vel"])
    told, done = torch.stack(told), torch.stack(done)
    limit = torch.tensor([(link.speed, link.acceleration) for link in PANDA_LINKS], dtype=torch.float64)
    assert (told.abs() <= limit[:, 0] + 1e-9).all()
    quickest = told.diff(dim=0).abs().amax((0, 1)) / SCENE.control_step
    torch.testing.assert_close(quickest, limit[:, 1])
    # Servos are a little soft: joints do what they are told but for single steps.
    assert ((done - told).abs() < 0.1).double().mean() > 0.9
    assert (done.abs() <= 1.05 * limit[:, 0]).all()


def test_an_episode_is_a_function_of_its_number():
    few, many = (ConveyorEnv(count, parts=2, seed=3, split="dev", num_threads=1) for count in (2, 5))
    one, all_of_them = (driven(env, torch.full((env.num_envs, 7), 0.1), 8) for env in (few, many))
    for key in ("targets_pos", "joint_pos", "target_quat"):
        assert torch.equal(one[key], all_of_them[key][:, :2])


def test_the_planner_takes_parts_and_who_runs_after_them_does_not():
    how = {"episodes": 6, "split": "dev", "num_envs": 6, "num_threads": 1, "progress": False, "speed": 0.6}
    found = evaluate(TASK, ["meet"], **how)
    assert found.rows[0].success_solvable >= 0.8
    assert not (found.outcomes["meet"].success & ~found.outcomes["meet"].solvable).any()
    assert evaluate(TASK, ["pursuit"], static="gain", **how).rows[0].success <= 0.2


@pytest.mark.parametrize("rule", [{"hold_angle": 0.01, "hold_steps": 5}, {"hold_distance": 1e-4}])
def test_cups_hold_nothing_that_is_not_before_them_as_they_need(rule):
    env = ConveyorEnv(2, speed=0.6, seed=0, split="dev", num_threads=1, scene=ConveyorScene(**rule))
    with torch.no_grad():
        seen = env.rollout(110, TASK.planner("first").with_parts(scene=None), break_when_any_done=False)
    assert not seen["next", "taken"].any()


def test_several_parts_are_taken_one_after_the_other():
    env = ConveyorEnv(2, parts=2, seed=0, split="dev", num_threads=1)
    with torch.no_grad():
        seen = env.rollout(230, TASK.planner("meet"), break_when_any_done=False)
    assert seen["next", "taken"].any(dim=1).all()
    taken = seen["next", "parts_taken"].long().sum(-1)
    assert ((taken[:, 1:] - taken[:, :-1]) <= 1).all()
    # A part that was taken leaves its slot.
    assert not (seen["next", "targets_present"] & seen["next", "parts_taken"]).any()


def test_parts_that_come_by_too_fast_or_too_far_cannot_be_taken():
    place, yaw = draw_parts(SCENE, torch.arange(6), parts=1, speed=0.3, split="dev", seed=0)
    assert parts_solvable(SCENE, place, yaw, speed=0.3).all()
    near_the_end = torch.tensor([0.0, SCENE.gone_y - 0.02], dtype=torch.float64) + place * torch.tensor([1.0, 0.0])
    assert not parts_solvable(SCENE, near_the_end, yaw, speed=0.3).any()
    assert not parts_solvable(SCENE, place + torch.tensor([1.0, 0.0]), yaw, speed=0.3).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"part_mass": 0.0}, "part_mass must"),
        ({"home": (0.0,)}, "home must be a tuple of 7"),
        ({"feed_to": 1.0}, "feed_to"),
    ],
)
def test_a_scene_that_is_none_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        ConveyorScene(**change)


@pytest.mark.parametrize("settings", [{"parts": 0}, {"parts": 9}, {"speed": -0.1}, {"sensor": Sensor(noise=0.01)}])
def test_settings_that_cannot_be_are_refused(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        ConveyorEnv(**settings)


def test_its_planner_is_saved_and_loaded(tmp_path):
    planner = TASK.planner("meet")
    planner.save_pretrained(tmp_path)
    again = ChoosingPlanner.from_pretrained(tmp_path)
    env = ConveyorEnv(2, seed=0, split="dev", num_threads=1)
    seen = env.rollout(3, planner)[:, -1].exclude("plan", "next").set("step_count", torch.zeros(2, 1).long())
    with torch.no_grad():
        one, other = planner(seen.clone()), again(seen.clone())
    assert torch.equal(one["goal_pose"], other["goal_pose"])
    assert torch.equal(one["action"], other["action"])
    assert again.planner.turn == planner.planner.turn
    assert again.planner.static.acceleration == planner.planner.static.acceleration
