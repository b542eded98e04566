"""A TorchRL collector over environments in two processes, with a planner as its policy.

Environments in other processes carry what specs declare, and nothing else: the planner's primer declares its memory.
"""

import argparse
from functools import partial

import torch
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, TransformedEnv

from torchdyn_plan import DynamicPlanner
from torchdyn_plan.envs import TrapperEnv


def main() -> None:
    """Collect balls in each of two processes."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--balls", type=int, default=16, help="side by side in each process")
    parser.add_argument("--steps", type=int, default=500, help="control steps, 500 are a whole episode")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    planner = DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop").requires_grad_(False)
    # No seed: every copy plays episodes of its own.
    workers = ParallelEnv(2, partial(TrapperEnv, arguments.balls, velocity=2.0, num_threads=1))
    env = TransformedEnv(workers, planner.make_tensordict_primer())
    frames = 2 * arguments.balls * arguments.steps
    collector = Collector(
        env, planner, frames_per_batch=frames, total_frames=frames, auto_register_policy_transforms=False
    )
    for data in collector:
        first = data["episode"] == data["episode"][..., :1]
        trapped = (data["next", "trapped"].squeeze(-1) & first).any(-1)
        plans = (data["plan", "replanned"] & first).sum(-1).double()
        print(f"trapped {trapped.double().mean():.0%} of {trapped.numel()} balls, {plans.mean():.0f} plans a ball")
    collector.shutdown()


if __name__ == "__main__":  # processes that are spawned import this file
    main()
