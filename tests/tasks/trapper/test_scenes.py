"""The task in each of its scenes."""

import dataclasses

import pytest
import torch

from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.envs.trapper.scene import SCENES, TrapperScene, trapper_scene
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.task import SCENES as NAMES
from torchdyn_plan.tasks.trapper.task import TASK, trapper_task


def test_the_task_names_every_scene_and_takes_the_first_by_default():
    assert tuple(SCENES) == NAMES == tuple(TASK.scenes)
    assert TASK.scene == NAMES[0]
    # Networks, results and figures belong to these scenes, to the last number.
    assert [scene.digest() for scene in SCENES.values()] == ["cc49d789bb82e1c9", "8a40bf50f76a1b68"]
    assert TASK.digest() == TrapperScene().digest()
    assert trapper_scene() == SCENES["ur5"]


@pytest.mark.parametrize("name", NAMES)
def test_all_of_a_task_is_in_its_scene(name):
    task, scene = load_task("trapper", name), SCENES[name]
    assert (task.name, task.scene, task.digest()) == ("trapper", name, scene.digest())
    env = task.make_env(task.default_settings(), num_envs=2, seed=0, split="dev", num_threads=1)
    assert env.scene == scene
    assert env.scene_digest == scene.digest()
    static = task.static_planner("ik")
    assert static.arm.speed_limit.tolist() == pytest.approx([scene.joint_speed] * 6)
    assert {task.planner(planner).scene for planner in task.planners} == {scene.digest()}


def test_balls_roll_alike_in_all_scenes():
    of_the_arm = {"arm_speed", "acceleration_limit", "servo_speed", "servo_stiffness", "servo_damping", "home"}
    of_the_arm |= {"base_setback", "base_height"}
    first = dataclasses.asdict(SCENES[NAMES[0]])
    for scene in SCENES.values():
        changed = {name for name, value in dataclasses.asdict(scene).items() if value != first[name]}
        assert changed <= of_the_arm


def test_weights_carry_the_scene_in_their_names_but_for_the_first():
    assert TASK.weights_name == "trapper"
    assert load_task("trapper", "paper").weights_name == "trapper-paper"
    own = trapper_task(TrapperScene(arm_speed=1.1))
    assert own.weights_name == f"trapper-{own.digest()}"


def test_a_full_action_is_the_greatest_speed_of_the_scene():
    speeds = {}
    for name, scene in SCENES.items():
        env = TrapperEnv(1, scene=name, velocity=0.0, seed=0, num_threads=1)
        td, action = env.reset(), torch.zeros(1, 6)
        action[0, 5] = 1.0
        for _ in range(60):
            td = env.step(td.set("action", action))["next"]
        speeds[name] = float(td["joint_vel"][0, 5]) / scene.joint_speed
    assert speeds == pytest.approx(dict.fromkeys(SCENES, SCENES["ur5"].servo_speed), abs=0.04)


def test_a_planner_of_one_scene_is_refused_in_another():
    paper = load_task("trapper", "paper")
    with pytest.raises(InputError, match="belongs to another scene"):
        evaluate("trapper", {"pursuit": paper.planner("pursuit")}, episodes=1, progress=False)


def test_a_scene_that_there_is_not_is_answered_with_those_there_are():
    with pytest.raises(InputError, match=r"unknown scene of trapper 'papr' \(did you mean 'paper'\?\)"):
        load_task("trapper", "papr")
    with pytest.raises(InputError, match="unknown scene 'real'; choose from"):
        TrapperEnv(1, scene="real")
    with pytest.raises(InputError, match="fetch_reach has one scene alone, got 'paper'"):
        load_task("fetch_reach", "paper")
