"""A stock TorchRL script that knows nothing of this package: TD3 on an environment that it has by its name alone.

python examples/stock_torchrl.py --frames 200000      # or any other name that Gymnasium knows
"""

import argparse

import torch
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, GymEnv, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import MLP, AdditiveGaussianModule, TanhModule, ValueOperator
from torchrl.modules.tensordict_module.common import TensorDictModule
from torchrl.modules.tensordict_module.sequence import TensorDictSequential
from torchrl.objectives import SoftUpdate, TD3Loss

parser = argparse.ArgumentParser()
parser.add_argument("--env", default="torchdyn_plan.gym:torchdyn_plan/TrapperStaticFlat-v0")
for name, default in (("frames", 1200), ("batch", 256), ("warmup", 400), ("seed", 0)):
    parser.add_argument(f"--{name}", type=int, default=default)
arguments = parser.parse_args()
torch.manual_seed(arguments.seed)
torch.set_num_threads(1)

env = TransformedEnv(GymEnv(arguments.env), Compose(StepCounter(), DoubleToFloat(), RewardSum()))
env.set_seed(arguments.seed)
seen, acts = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
sizes = {"num_cells": [256, 256], "activation_class": nn.ReLU}
actor = TensorDictSequential(
    TensorDictModule(MLP(in_features=seen, out_features=acts, **sizes), ["observation"], ["param"]),
    TanhModule(in_keys=["param"], out_keys=["action"], spec=env.action_spec),
)
critic = ValueOperator(MLP(in_features=seen + acts, out_features=1, **sizes), in_keys=["action", "observation"])
loss = TD3Loss(actor, critic, action_spec=env.action_spec)
loss.make_value_estimator(gamma=0.97)
targets = SoftUpdate(loss, tau=0.005)
optimisers = {
    "loss_actor": torch.optim.Adam(loss.actor_network_params.flatten_keys().values(), lr=3e-4),
    "loss_qvalue": torch.optim.Adam(loss.qvalue_network_params.flatten_keys().values(), lr=3e-4),
}
noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.2, sigma_end=0.2)
replay = ReplayBuffer(storage=LazyTensorStorage(500_000), batch_size=arguments.batch)
collector = Collector(
    env,
    TensorDictSequential(actor, noise),
    frames_per_batch=200,
    total_frames=arguments.frames,
    init_random_frames=arguments.warmup,
    auto_register_policy_transforms=False,
)
frames = updates = 0
for data in collector:
    frames += data.numel()
    replay.extend(data)
    for _ in range(200 if frames > arguments.warmup else 0):
        found, updates = loss(replay.sample()), updates + 1
        for name, optimiser in optimisers.items():
            if name == "loss_qvalue" or updates % 2 == 0:
                optimiser.zero_grad()
                found[name].backward()
                optimiser.step()
        targets.step()
    ended = data["next", "done"].squeeze(-1)
    returns = data["next", "episode_reward"].squeeze(-1)[ended]
    print(f"{frames:8d} frames: return {returns.mean():8.2f}")
