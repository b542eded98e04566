"""Stable-Baselines3's SAC with hindsight on the goal task, by its name in Gymnasium: pip install stable-baselines3.

python examples/sb3_her.py --steps 200000
"""

import argparse

import gymnasium
import torch
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy

import torchdyn_plan.gym  # noqa: F401  # registers the names

parser = argparse.ArgumentParser()
parser.add_argument("--env", default="torchdyn_plan/TrapperStatic-v0")
parser.add_argument("--steps", type=int, default=600)
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()
torch.set_num_threads(1)

env = gymnasium.make(arguments.env, num_threads=1)
model = SAC(
    "MultiInputPolicy",
    env,
    gamma=0.97,
    batch_size=256,
    learning_starts=200,
    replay_buffer_class=HerReplayBuffer,
    replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    seed=arguments.seed,
)
model.learn(arguments.steps)
mean, deviation = evaluate_policy(model, env, n_eval_episodes=2, warn=False)
print(f"return {mean:.2f} +/- {deviation:.2f} after {arguments.steps} steps")
