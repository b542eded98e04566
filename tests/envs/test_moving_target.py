"""What every environment of this package does, in the smallest world."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from tests.envs.points import STRIDE, PointEnv
from torchdyn_plan import keys
from torchdyn_plan.envs import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import ProportionalController, TargetPursuit


def pursuit(scene=None):
    return TargetPursuit(ProportionalController(gain=1.0 / STRIDE), scene=scene)


@pytest.mark.parametrize(
    "settings",
    [{}, {"static_target": True, "history": 5}, {"num_envs": 1}, {"coordinates": 2, "goal_in_observation": True}],
)
def test_specs_hold(settings):
    check_env_specs(PointEnv(**settings))


def test_a_robot_without_joints_shows_none_and_every_other_key_of_the_table():
    rollout = PointEnv(3, static_target=True).rollout(4)
    sizes = {"D": 3, "A": 3, "H": 24, "S": 3}
    for key in keys.KEYS:
        joints = key.name in (keys.JOINT_POS, keys.JOINT_VEL)
        if joints:
            assert key.name not in rollout.keys()  # noqa: SIM118
        elif key.writer == "env" or key.name in (keys.GOAL, keys.ACTION):
            shape = tuple(sizes[size] if isinstance(size, str) else size for size in key.shape)
            assert rollout[key.name].shape == (3, 4, *shape), key


def test_in_a_plane_every_place_has_two_coordinates():
    rollout = PointEnv(3, coordinates=2, control_step=0.1, sensor=Sensor(noise=0.01)).rollout(4)
    sizes = {"D": 2, "A": 2, "H": 24, "S": 2, "M": rollout["measured_time"].shape[-1]}
    for key in keys.KEYS:
        if key.name in rollout.keys():  # noqa: SIM118
            shape = tuple(sizes[size] if isinstance(size, str) else size for size in key.shape)
            assert rollout[key.name].shape == (3, 4, *shape), key
    with pytest.raises(InputError, match="coordinates must be in"):
        PointEnv(coordinates=4)


def test_any_flag_ends_an_episode_and_the_first_one_is_rewarded():
    rollout = PointEnv(64, seed=3, max_steps=60).rollout(60, pursuit(), break_when_any_done=False)["next"]
    met, gone = rollout["met"], rollout["gone"]
    assert met.any()
    assert gone.any()
    assert torch.equal(rollout["reward"], met.float())
    assert torch.equal(rollout["terminated"], met | gone)
    assert torch.equal(rollout["done"], rollout["terminated"] | rollout["truncated"])


def test_a_reset_in_the_midst_takes_the_next_episode_and_its_start():
    env = PointEnv(4, max_steps=7)
    td = env.reset()
    starts = td[keys.TARGET_POS].clone()
    for _ in range(8):
        stepped, td = env.step_and_maybe_reset(pursuit()(td))
        fresh = stepped["next", "done"].squeeze(-1)
        assert (td[keys.STEP_COUNT][fresh] == 0).all()
        assert (td[keys.EPISODE][fresh] >= 4).all()
    assert env.next_episode >= 8
    again = PointEnv(8)
    torch.testing.assert_close(again.reset()[keys.TARGET_POS][:4], starts)


def test_a_step_counts_and_is_seen():
    env = PointEnv(2)
    env.reset()
    assert env.step_count.tolist() == [0, 0]
    before = env.target_pos.clone()
    env.rand_step()
    assert env.step_count.tolist() == [1, 1]
    assert ((env.target_pos - before)[:, 0] > 0).all()


def test_a_planner_of_another_scene_is_refused():
    env = PointEnv(scene="here")
    with pytest.raises(InputError, match="the planner belongs to scene there, but the environment's scene is here"):
        env.rollout(2, pursuit("there"))
    for planner in (pursuit("here"), pursuit(), lambda td: td.set("action", torch.zeros(2, 3))):
        assert env.rollout(2, planner).shape == (2, 2)
    assert PointEnv().rollout(2, pursuit("anywhere")).shape == (2, 2)


def test_a_world_without_a_word_for_success_is_refused():
    class Mute(PointEnv):
        flags = ()

    with pytest.raises(InputError, match=r"Mute\.flags must name at least the flag of success"):
        Mute()
