"""What a planner sees of Trapper's arms and balls at the step of its first plan."""

import torch

from torchdyn_plan.envs import TrapperEnv

FIRST_STEP = 13


def first_plan(count, **settings):
    """Tensordict of ``count`` episodes after `FIRST_STEP` steps in which the arm stood still."""
    env = TrapperEnv(count, seed=0, num_threads=1, **settings)
    td = env.reset()
    for _ in range(FIRST_STEP):
        td = env.step_mdp(env.step(td.set("action", torch.zeros(count, 6))))
    return td.exclude("action")
