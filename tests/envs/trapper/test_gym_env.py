"""The goal task by Gymnasium's conventions."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

from torchdyn_plan.envs.trapper.gym_env import TrapperGymEnv  # noqa: E402


@pytest.fixture(scope="module")
def env() -> TrapperGymEnv:
    return TrapperGymEnv(seed=1, num_threads=1, max_steps=20)


def test_passes_gymnasiums_checks(env: TrapperGymEnv) -> None:
    check_env(env, skip_render_check=True)


def test_compute_reward_is_the_steps_reward_row_by_row_and_at_once(env: TrapperGymEnv) -> None:
    draw = np.random.default_rng(0)
    env.reset(seed=1)
    steps = [env.step(draw.uniform(-1, 1, 6).astype(np.float32)) for _ in range(20)]
    achieved, desired = (np.stack([step[0][key] for step in steps]) for key in ("achieved_goal", "desired_goal"))
    rewards = np.array([step[1] for step in steps], dtype=np.float32)
    assert np.array_equal(env.compute_reward(achieved, desired, {}), rewards)
    assert np.array_equal([env.compute_reward(*row, {}) for row in zip(achieved, desired, strict=True)], rewards)
    assert [step[3] for step in steps] == [False] * 19 + [True]
    assert (desired == desired[0]).all()
