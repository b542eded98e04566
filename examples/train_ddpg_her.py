"""Teach the arm to reach goals: DDPG with hindsight experience replay, the whole loop on one page.

python examples/train_ddpg_her.py --rounds 100        # some minutes; `torchdyn-plan train policy` resumes and logs too
"""

import argparse

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.modules import AdditiveGaussianModule, ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate

from torchdyn_plan.envs import TrapperGoalEnv
from torchdyn_plan.envs.trapper.reward import goal_reward
from torchdyn_plan.nets import Actor, Critic, PolicyConfig
from torchdyn_plan.training.hindsight import HindsightReplayBuffer

parser = argparse.ArgumentParser()
parser.add_argument("--rounds", type=int, default=3)
parser.add_argument("--num-envs", type=int, default=32)
parser.add_argument("--updates", type=int, default=100, help="optimiser steps a round")
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()
torch.manual_seed(arguments.seed)
torch.set_num_threads(1)

LENGTH, SEEN = 100, ["observation", "desired_goal"]
AFTER = [*SEEN, "achieved_goal", "tool_pos", "tool_rotation", "reward", "done", "terminated"]
env = TrapperGoalEnv(arguments.num_envs, max_steps=LENGTH, split="train", seed=arguments.seed)
actor, critic = Actor(PolicyConfig()), Critic(PolicyConfig())
shown = env.rollout(LENGTH, break_when_any_done=False).reshape(-1)
for network in (actor, critic):  # what random actions show sets the scale of what the networks see
    network.features.set_statistics(shown["observation"], shown["desired_goal"])
policy = TensorDictModule(actor, in_keys=SEEN, out_keys=["action"])
value = ValueOperator(critic, in_keys=[*SEEN, "action"])

loss = DDPGLoss(policy, value, delay_actor=True, delay_value=True)
loss.make_value_estimator(gamma=0.97)
targets = SoftUpdate(loss, tau=0.01)
optimiser = torch.optim.Adam([{"params": actor.parameters(), "lr": 5e-4}, {"params": critic.parameters(), "lr": 1e-3}])


def reward(transitions: TensorDictBase) -> torch.Tensor:
    """The environment's own reward, for whatever goal hindsight put in."""
    after = transitions["next"]
    return goal_reward(env.scene, env.weights, after["tool_pos"], after["tool_rotation"], transitions["desired_goal"])


replay = HindsightReplayBuffer(reward, capacity=500_000, length=LENGTH, batch_size=256)
noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.2, sigma_end=0.2)
frames = arguments.num_envs * LENGTH
collector = Collector(
    env,
    TensorDictSequential(policy, noise),
    frames_per_batch=frames,
    total_frames=arguments.rounds * frames,
    init_random_frames=2 * frames,
)

for number, episodes in enumerate(collector):
    replay.extend(episodes.select(*SEEN, "action", *(("next", key) for key in AFTER)))
    if number > 0:
        for _ in range(arguments.updates):
            losses = loss(replay.sample())
            optimiser.zero_grad()
            (losses["loss_actor"] + losses["loss_value"]).backward()
            optimiser.step()
            targets.step()
    print(f"round {number + 1:4d}: mean reward {episodes['next', 'reward'].mean():+.3f}")
actor.save_pretrained("runs/example")
