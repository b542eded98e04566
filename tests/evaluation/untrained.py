"""A dynamic planner of untrained networks: it plans nonsense, at the right steps."""

import torch

from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import DynamicPlanner
from torchdyn_plan.tasks.trapper.task import ik_planner


def untrained(**parts):
    torch.manual_seed(0)
    # Narrower ones, and smaller blocks, take kernels whose last bit depends on a row's place in the block.
    nets = Forecaster(hidden=64).eval(), ETANetwork(hidden=64).eval()
    return DynamicPlanner.paper(ik_planner(chunk=32), *nets, chunk=32, **parts).requires_grad_(False)
