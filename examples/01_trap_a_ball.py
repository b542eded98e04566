"""A planner for static goals, made to trap rolling balls: 64 episodes at 3 m/s, with the networks that ship."""

import torch

from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.planners import DynamicPlanner, TargetPursuit

torch.set_num_threads(1)  # networks this small are fastest on one thread

paper = DynamicPlanner.from_pretrained("trapper-ik")
planners = {
    "pursuit": TargetPursuit(paper.static),
    "the paper's": paper,
    "ours": DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop"),
}
for name, planner in planners.items():
    env = TrapperEnv(num_envs=64, velocity=3.0, seed=0)
    with torch.no_grad():
        rollout = env.rollout(500, planner, break_when_any_done=False)
    first = rollout[:, : env.max_steps]
    in_first_episode = first["episode"] == first["episode"][:, :1]
    trapped = (first["next", "trapped"].squeeze(-1) & in_first_episode).any(-1)
    print(f"{name:11} traps {trapped.double().mean():.0%} of {len(trapped)} balls")
