"""Catch: the UR10 against a published description, the ball against its law, the cup's rule, the planners."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchdyn_plan.envs import Sensor
from torchdyn_plan.envs.catch import CatchEnv, CatchScene, ur10_arm
from torchdyn_plan.envs.catch.throws import draw_throws
from torchdyn_plan.envs.catch.ur10 import UR10_LINKS
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import BallisticTrack, DynamicPlanner, TrackedPlanner
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.catch.solvable import find_truth, flights_solvable

SCENE = CatchScene()
TASK = load_task("catch")
DEV = {"seed": 0, "split": "dev"}
JOINTS = [0.3, -0.5, 0.4, -2.1, 0.6, 1.7]
PUBLISHED = [
    [0.804234803, 0.195159581, 0.561354718, -1.046260571],
    [0.324931281, 0.646483912, -0.690274014, -0.574905376],
    [-0.497620382, 0.737544093, 0.456511409, 0.588023025],
    [0.0, 0.0, 0.0, 1.0],
]
"""Pose of tool0 in the frame base at these joints by ur10_robot.urdf of example-robot-data."""


def driven(env, action, steps):
    """What is seen after each of some steps under one action, ``(steps, N, …)`` by key."""
    td, seen = env.reset(), []
    for _ in range(steps):
        td = env.step(td.set("action", action.clone()))["next"]
        seen.append(dict(td.items()))
    return {key: torch.stack([one[key] for one in seen]) for key in seen[0]}


@pytest.mark.parametrize("settings", [{"num_envs": 2}, {"static_target": True}, {"sensor": Sensor(noise=0.003)}])
def test_specs_hold(settings):
    check_env_specs(CatchEnv(seed=0, num_threads=1, **settings))


def test_its_arm_is_the_published_ur10():
    pose = ur10_arm(dtype=torch.float64)(torch.tensor(JOINTS, dtype=torch.float64))
    torch.testing.assert_close(pose, pose.new_tensor(PUBLISHED), atol=1e-8, rtol=0)


def test_the_simulated_cup_is_where_the_arm_says():
    env = CatchEnv(3, num_threads=1, **DEV)
    seen = driven(env, torch.linspace(-0.4, 0.4, 18).view(3, 6), 25)
    tool = env.simulation.model.body("tool").id
    env.simulation.batch.forward(None)
    place, turn = (torch.tensor(env.simulation.batch.bind(name))[:, tool] for name in ("xpos", "xmat"))
    torch.testing.assert_close(seen["tool_pos"][-1].double(), place, atol=1e-5, rtol=0)
    torch.testing.assert_close(env._tool_rotation.double(), turn.view(3, 3, 3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("drag", [0.0, 0.0195, 0.1])
def test_a_ball_flies_by_its_law_and_its_future_is_foretold(drag):
    env = CatchEnv(6, drag=drag, num_threads=1, **DEV)
    env.reset()
    future = env.true_future(torch.arange(6), 70)
    seen = driven(CatchEnv(6, drag=drag, num_threads=1, **DEV), torch.zeros(6, 6), 70)["target_pos"].transpose(0, 1)
    torch.testing.assert_close(seen, future, atol=1e-3, rtol=0)
    truth = find_truth(TASK.default_settings(drag=drag), episodes=6, **DEV)
    torch.testing.assert_close(truth.future[:, 1:71], future, atol=1e-4, rtol=0)


def test_throws_are_within_their_ranges_and_fly_through_their_aim():
    place, velocity = draw_throws(SCENE, torch.arange(200), flight=0.7, drag=0.05, split="train", seed=1)
    away, angle = place[:, :2].norm(dim=-1), torch.atan2(place[:, 1], place[:, 0])
    assert 2.5 <= away.min() < 2.7
    assert 3.8 < away.max() <= 4.0
    assert 0.4 < angle.abs().max() <= torch.pi * 25 / 180
    assert 1.0 <= place[:, 2].min() < place[:, 2].max() <= 1.8
    env = CatchEnv(200, drag=0.05, seed=1, split="train", num_threads=1)
    env.reset()
    path = env.true_future(torch.arange(200), 120)
    aims = (path >= torch.tensor(SCENE.aim_low) - 1e-3) & (path <= torch.tensor(SCENE.aim_high) + 1e-3)
    assert aims.all(-1).any(-1).all()
    assert 3.0 < velocity.norm(dim=-1).min() < velocity.norm(dim=-1).max() < 9.0


def test_no_joint_is_told_to_be_faster_or_quicker_than_it_may_be():
    torch.manual_seed(0)
    env, told, done = CatchEnv(8, seed=0, num_threads=1), [], []
    td = env.reset()
    for _ in range(50):
        td = env.step(td.set("action", (torch.rand(8, 6) * 1.4 - 0.7).round()))["next"]
        told.append(env.simulation.told_speed.clone())
        done.append(td["joint_vel"])
    told, done = torch.stack(told), torch.stack(done)
    limit = torch.tensor([(link.speed, link.acceleration) for link in UR10_LINKS], dtype=torch.float64)
    assert (told.abs() <= limit[:, 0] + 1e-9).all()
    quickest = told.diff(dim=0).abs().amax((0, 1)) / SCENE.control_step
    torch.testing.assert_close(quickest, limit[:, 1])
    # Servos are a little soft.
    assert ((done - told).abs() < 0.1).double().mean() > 0.9


def test_an_episode_is_a_function_of_its_number():
    few, many = (CatchEnv(count, seed=3, split="dev", num_threads=1) for count in (2, 5))
    one, all_of_them = (driven(env, torch.full((env.num_envs, 6), 0.1), 8) for env in (few, many))
    for key in ("target_pos", "joint_pos", "tool_pos"):
        assert torch.equal(one[key], all_of_them[key][:, :2])


@pytest.mark.parametrize(
    ("place", "caught"), [((0.0, 0.0, -0.05), True), ((0.0, 0.0, 0.3), False), ((0.15, 0.0, -0.05), False)]
)
def test_a_ball_is_caught_that_stays_in_the_cup(place, caught):
    env = CatchEnv(1, num_threads=1, **DEV)
    td = env.reset()
    inside = env._tool_pos[0].double() + env._tool_rotation[0].double() @ torch.tensor(place, dtype=torch.float64)
    env.simulation.place_balls(inside.unsqueeze(0))
    flags = []
    for _ in range(SCENE.hold_steps + 20):
        td = env.step(td.set("action", torch.zeros(1, 6)))["next"]
        flags.append((bool(td["caught"]), bool(td["missed"])))
    assert not any(one for one, _ in flags[: SCENE.hold_steps - 1])
    assert any(one for one, _ in flags) == caught
    if caught:
        assert not any(other for _, other in flags)


@pytest.mark.parametrize(("name", "least", "most"), [("meet", 4, 4), ("pursuit", 0, 1)])
def test_the_planner_meets_balls_that_are_measured_with_noise_and_who_runs_after_them_does_not(name, least, most):
    assert find_truth(TASK.default_settings(), episodes=4, **DEV).solvable.all()
    env = CatchEnv(4, sensor=Sensor(noise=0.003, rate=60.0), num_threads=1, **DEV)
    planner = TrackedPlanner(TASK.planner(name), BallisticTrack(noise=0.003), control_step=env.control_step)
    with torch.no_grad():
        seen = env.rollout(150, planner, break_when_any_done=False)
    assert least <= seen["next", "caught"].any(dim=1).sum() <= most


def test_flights_that_are_too_fast_or_too_far_cannot_be_met():
    truth = find_truth(TASK.default_settings(), episodes=12, **DEV)
    assert truth.solvable.any()
    assert flights_solvable(SCENE, truth.future)[truth.solvable].all()
    # The same flight twice as fast leaves less time, and one that passes 3 m away none at all.
    fast = torch.cat([truth.future[:, ::2], truth.future[:, -1:].expand(-1, 170, 3)], dim=1)
    assert flights_solvable(SCENE, fast).sum() < truth.solvable.sum()
    assert not flights_solvable(SCENE, truth.future + torch.tensor([0.0, 3.0, 0.0])).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ball_mass": 0.0}, "ball_mass must"),
        ({"home": (0.0,)}, "home must be a tuple of 6"),
        ({"throw_to": 1.0}, "throw_to"),
        ({"aim_low": (2.0, 0.0, 0.0)}, "aim_low must be below aim_high"),
        ({"ball_radius": 0.08}, "ball_radius must be below cup_radius"),
    ],
)
def test_a_scene_that_is_none_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        CatchScene(**change)


@pytest.mark.parametrize("settings", [{"flight": 0.1}, {"drag": -0.1}, {"flight": float("nan")}])
def test_settings_that_cannot_be_are_refused(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        CatchEnv(**settings)


def test_its_planner_is_saved_and_loaded(tmp_path):
    planner = TASK.planner("meet")
    planner.save_pretrained(tmp_path)
    again = DynamicPlanner.from_pretrained(tmp_path)
    env = CatchEnv(2, num_threads=1, **DEV)
    seen = env.rollout(3, planner)[:, -1].exclude("plan", "next").set("step_count", torch.ones(2, 1).long())
    with torch.no_grad(), pytest.warns(RuntimeWarning, match="memory is missing"):
        one, other = planner(seen.clone()), again(seen.clone())
    assert torch.equal(one["goal_pose"], other["goal_pose"])
    assert torch.equal(one["action"], other["action"])
    assert (again.turn, again.maneuver) == (planner.turn, planner.maneuver)
    assert again.forecaster.part_settings() == planner.forecaster.part_settings()
