"""What a task says without importing its world is what its world says."""

import pytest

from torchdyn_plan.tasks import load_task


@pytest.mark.parametrize(
    ("name", "scene"), [("trapper", "ur5"), ("trapper", "paper"), ("catch", None), ("chase", None), ("conveyor", None)]
)
def test_steps_are_those_of_the_environment(name, scene):
    task = load_task(name, scene) if scene else load_task(name)
    env = task.make_env(task.default_settings(), num_envs=1, seed=0, split="dev", num_threads=1)
    assert (task.control_step, task.max_steps) == (env.control_step, env.max_steps)
