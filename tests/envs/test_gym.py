"""The worlds by Gymnasium's conventions."""

import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from torchrl.envs import GymEnv  # noqa: E402

import torchdyn_plan.gym  # noqa: E402
from tests.scripts import run  # noqa: E402
from torchdyn_plan.errors import InputError  # noqa: E402

NAMES = sorted(torchdyn_plan.gym.FORMS)
GOALS = [name for name in NAMES if "Flat" not in name and "Dynamic" not in name]
EACH = pytest.mark.parametrize("name", NAMES)


def make(name, **settings):
    return gymnasium.make(f"torchdyn_plan/{name}", num_threads=1, **settings).unwrapped


def make_vec(name, num_envs, **settings):
    return gymnasium.make_vec(f"torchdyn_plan/{name}", num_envs=num_envs, num_threads=1, **settings)


def rows(shown):
    return shown if isinstance(shown, dict) else {"": shown}


def assert_same(one, other):
    one, other = rows(one), rows(other)
    assert one.keys() == other.keys()
    for key, value in one.items():
        assert np.array_equal(value, other[key]), key


@pytest.mark.filterwarnings("ignore:.*A Box observation space m.*")
@pytest.mark.filterwarnings("ignore:.*render check.*")
@EACH
def test_passes_gymnasiums_checks(name):
    check_env(make(name), skip_render_check=True)


@EACH
def test_passes_the_checks_of_stable_baselines(name):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(make(name))


@EACH
def test_the_vector_is_the_single_environment_row_by_row(name):
    many, steps = make_vec(name, 3, max_steps=4, seed=2), 10
    draw = np.random.default_rng(0)
    actions = draw.uniform(-1, 1, (steps, *many.action_space.shape)).astype(np.float32)
    seen, _ = many.reset()
    for row in range(3):
        alone = make(name, max_steps=4, seed=2)
        alone.world.start_from(row)
        assert_same(alone.reset()[0], {key: value[row] for key, value in rows(seen).items()})
    for action in actions:
        seen, reward, terminated, truncated, infos = many.step(action)
        assert reward.shape == terminated.shape == truncated.shape == infos["is_success"].shape == (3,)
        done = terminated | truncated
        if done.any():
            assert np.array_equal(infos["_final_obs"], done)
            last = infos["final_obs"][done.nonzero()[0][0]]
            assert {key: value.shape for key, value in rows(last).items()} == {
                key: value.shape[1:] for key, value in rows(seen).items()
            }
            assert infos["final_info"]["is_success"].shape == (3,)
    assert many.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.SAME_STEP
    many.close()


@EACH
def test_a_row_of_the_vector_goes_the_way_of_the_single_environment(name):
    many, alone = make_vec(name, 2, seed=4), make(name, seed=4)
    many.reset()
    alone.reset()
    for step in range(8):
        action = np.full(many.single_action_space.shape, 0.1 * step, dtype=np.float32)
        seen, reward, _, _, infos = many.step(np.stack([action, action]))
        single, value, _, _, info = alone.step(action)
        assert_same(single, {key: entry[0] for key, entry in rows(seen).items()})
        assert (value, info["is_success"]) == (reward[0], infos["is_success"][0])


@pytest.mark.parametrize("name", GOALS)
def test_compute_reward_is_the_steps_reward_row_by_row_and_at_once(name):
    env = make(name, max_steps=20)
    draw = np.random.default_rng(0)
    seen, _ = env.reset(seed=1)
    steps, sought = [], []
    for _ in range(20):
        # Trapper pays for the goal that was shown; a moving goal of Reach is paid where it has come to.
        sought.append(seen["desired_goal"])
        seen, *rest = env.step(draw.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        steps.append((seen, *rest))
    achieved, desired = (np.stack([step[0][key] for step in steps]) for key in ("achieved_goal", "desired_goal"))
    rewards = np.array([step[1] for step in steps], dtype=np.float32)
    assert np.array_equal(env.compute_reward(achieved, desired, {}), rewards)
    assert np.array_equal([env.compute_reward(*row, {}) for row in zip(achieved, desired, strict=True)], rewards)
    assert [step[3] for step in steps] == [False] * 19 + [True]
    if name == "TrapperStatic-v0":
        assert (desired == desired[0]).all()


@EACH
def test_copies_without_a_seed_differ_and_seeded_ones_do_not(name):
    starts = [rows(make(name).reset()[0]) for _ in range(3)]
    goal = "desired_goal" if "desired_goal" in starts[0] else ""
    assert len({start[goal].tobytes() for start in starts}) == 3
    assert_same(make(name).reset(seed=7)[0], make(name).reset(seed=7)[0])
    vector = make_vec(name, 2)
    assert_same(vector.reset(seed=7)[0], vector.reset(seed=7)[0])


def test_gymnasiums_own_vector_of_copies_plays_different_episodes():
    vector = gymnasium.make_vec("torchdyn_plan/TrapperStatic-v0", num_envs=3, vectorization_mode="sync", num_threads=1)
    assert len(np.unique(vector.reset()[0]["desired_goal"], axis=0)) == 3


@EACH
def test_an_environment_is_pickled_as_it_was_made(name):
    env = make(name, max_steps=7)
    copy = pickle.loads(pickle.dumps(env))
    assert copy.world.max_steps == 7
    assert_same(copy.reset(seed=3)[0], env.reset(seed=3)[0])


def test_success_is_told():
    env = make("ReachStatic-v0", threshold=0.5)
    env.reset(seed=0)
    assert env.step(np.zeros(4, dtype=np.float32))[4] == {"is_success": True}
    far = make("ReachStatic-v0", threshold=1e-5)
    far.reset(seed=0)
    assert far.step(np.zeros(4, dtype=np.float32))[4] == {"is_success": False}


def test_a_name_alone_is_enough():
    code = "import gymnasium; print(gymnasium.make('torchdyn_plan.gym:torchdyn_plan/TrapperStaticFlat-v0').spec.id)"
    ran = run(code, cwd=".")
    assert ran.stdout.strip() == "torchdyn_plan/TrapperStaticFlat-v0", ran.stderr


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="needs a form with a reward, got one without"):
        torchdyn_plan.envs.gym_env.GoalGymEnv("torchdyn_plan.envs.trapper.gym_forms:DYNAMIC")
    assert not hasattr(make("TrapperDynamic-v0"), "compute_reward"), "libraries take it for a world of goals"
    with pytest.raises(InputError, match=r"form must be a GymForm or the place of one, module:NAME, got 'torch:nope'"):
        gymnasium.make("torchdyn_plan/Reach-v0", form="torch:nope")
    with pytest.raises(InputError, match=r"seed must be a finite number, got \[1, 2\]"):
        make_vec("TrapperStatic-v0", 2).reset(seed=[1, 2])
    with pytest.raises(InputError, match="unknown render_mode 'human'"):
        torchdyn_plan.envs.gym_env.GymEnv("torchdyn_plan.envs.trapper.gym_forms:STATIC", render_mode="human")
    assert make("TrapperStatic-v0").render() is None


def test_worlds_draw_themselves_and_torchrls_transform_takes_the_pictures():
    """In a process of its own: graphics are chosen when MuJoCo is imported."""
    code = """
import gymnasium, numpy as np, torch, torchdyn_plan.gym
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.record import PixelRenderTransform
from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.errors import InputError
for name in ("TrapperDynamic-v0", "TrapperStatic-v0", "Reach-v0"):
    env = gymnasium.make(f"torchdyn_plan/{name}", render_mode="rgb_array", num_threads=1)
    env.reset(seed=0)
    try:
        one = env.render()
    except InputError as error:
        assert "MUJOCO_GL" in str(error), error
        print("cannot draw")
        break
    for _ in range(30):
        env.step(np.ones(env.action_space.shape, dtype=np.float32))
    other = env.render()
    many = gymnasium.make_vec(f"torchdyn_plan/{name}", num_envs=2, render_mode="rgb_array", num_threads=1)
    many.reset(seed=0)
    pair = many.render()
    assert one.shape == (240, 320, 3) and one.dtype == np.uint8 and one.std() > 10, one.std()
    assert (one != other).any(-1).mean() > 0.005, name
    assert len(pair) == 2 and (pair[0] != pair[1]).any(), name
else:
    env = TrapperEnv(2, seed=0, num_threads=1, render_mode="rgb_array")
    pictured = TransformedEnv(env, PixelRenderTransform(width=64, height=48))
    check_env_specs(pictured)
    pixels = pictured.rollout(3)["next", "pixels"]
    assert pixels.shape == (2, 3, 48, 64, 3) and pixels.dtype == torch.uint8, (pixels.shape, pixels.dtype)
"""
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    if "cannot draw" in done.stdout:
        pytest.skip("no graphics here")


def test_torchrls_own_wrapper_takes_a_name():
    env = GymEnv("torchdyn_plan/TrapperStaticFlat-v0", num_threads=1)
    rollout = env.rollout(5)
    assert rollout["observation"].shape == (5, 18)
    assert rollout["next", "reward"].shape == (5, 1)
