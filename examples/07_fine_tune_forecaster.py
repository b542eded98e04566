"""Fine-tune the forecaster on what matters for trapping: where the ball truly is when the robot means to meet it.

The soft search passes gradients from the meeting back to the forecast. Seconds by default; a longer run, with the
success of the exact search before and after: --steps 200 --balls 256 --batch 64 --episodes 1000 --out FOLDER
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.episodes import draw_starts
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.run import record_truth, run_episodes
from torchdyn_plan.evaluation.solvability import record_path
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import DynamicPlanner, ExactSearch, IKPlanner, SoftExactSearch
from torchdyn_plan.planners.soft import between

parser = argparse.ArgumentParser(description=__doc__)
for name, default in (("steps", 5), ("balls", 32), ("batch", 32), ("lr", 3e-5), ("episodes", 0), ("out", Path())):
    parser.add_argument(f"--{name}", type=type(default), default=default)
arguments = parser.parse_args()
scene, static = TrapperScene(), IKPlanner()
forecaster, eta = Forecaster.from_pretrained("trapper"), ETANetwork.from_pretrained("trapper-ik").requires_grad_(False)
planner = DynamicPlanner(static, forecaster, eta, search=SoftExactSearch(temperature=2.0))


def roll(first: int, count: int) -> Tensor:
    """True paths (count, 601, 3) of balls of the training split, at 1 to 5 m/s each [m, world]."""
    place, velocity = draw_starts(scene, torch.arange(first, first + count), velocity=1.0, split="train", seed=7)
    speed = torch.linspace(1.0, 5.0, count, dtype=velocity.dtype).unsqueeze(-1)
    return record_path(scene, place, velocity * speed, steps=600)


def situations(paths: Tensor, count: int, draw: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Robot states (count, 15) around home, histories (count, 24, 3) and the truth from now on (count, 301, 3)."""
    ball = torch.randint(len(paths), (count, 1), generator=draw)
    now = torch.randint(13, 300, (count, 1), generator=draw)
    history = paths[ball, (now + torch.arange(-23, 1)).clamp_min(0)]
    joints = torch.tensor(scene.home) + 0.3 * torch.randn(count, 6, generator=draw)
    tool_pos = static.arm(joints)[:, :3, 3] + torch.tensor(scene.base_pos)
    return torch.cat([joints, 0.0 * joints, tool_pos], dim=-1), history, paths[ball, now + torch.arange(301)]


def misses(state: Tensor, history: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """How far the ball truly is from the goal at the meeting time [m], and how late the robot [steps], where it can."""
    goal, steps, _, reachable = planner.plan(state, truth[:, 0], history)
    there = between(truth, steps.unsqueeze(-1)).squeeze(-2)
    late = (eta.arrival(state, goal, reading="soft").steps - steps).relu()
    return (there - goal)[reachable, :2].norm(dim=-1), late[reachable]


def report(when: str) -> None:
    """Print what is missed in situations that training does not see."""
    miss, late = (figures.detach() for figures in misses(*held_out))
    print(f"{when}: miss {miss.median():.4f} m (median), {late.mean():.2f} steps late")
    if arguments.episodes:
        setting = EvaluateArguments(episodes=arguments.episodes, num_envs=arguments.episodes, split="dev")
        exact = DynamicPlanner(static, forecaster, eta, search=ExactSearch())
        trapped = run_episodes(exact, setting, *record_truth(setting), when).trapped
        print(f"{when}: {int(trapped.sum())} of {arguments.episodes} balls at 3 m/s trapped (dev)")


paths, draw = roll(0, arguments.balls), torch.Generator().manual_seed(1)
held_out = situations(roll(100_000, 32), 128, torch.Generator().manual_seed(2))
report("before")
optimiser = torch.optim.Adam(forecaster.parameters(), lr=arguments.lr)
for step in range(arguments.steps):
    miss, late = misses(*situations(paths, arguments.batch, draw))
    loss = (miss / (miss + 0.05)).mean() + 0.02 * late.mean()  # To miss by a metre is no worse than by ten centimetres.
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    print(f"\rstep {step + 1:4}: loss {loss.item():.4f} ", end="", flush=True)
report("\nafter")
if arguments.out.name:
    print(f"written: {forecaster.save_pretrained(arguments.out)}")
