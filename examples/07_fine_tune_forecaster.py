"""Fine-tune the forecaster on what matters for trapping: where the ball truly is when the robot means to meet it.

The soft search passes gradients from the meeting back to the forecast. Seconds by default; a longer run, with the
success of the exact search before and after: --steps 200 --balls 256 --batch 64 --episodes 1000 --out FOLDER
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.nets import Forecaster
from torchdyn_plan.planners import ExactSearch, Observation, Plan, SoftExactSearch
from torchdyn_plan.planners.search.soft import between
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.solvable import record_path

parser = argparse.ArgumentParser(description=__doc__)
for name, default in (("steps", 5), ("balls", 32), ("batch", 32), ("lr", 3e-5), ("episodes", 0), ("out", Path())):
    parser.add_argument(f"--{name}", type=type(default), default=default)
arguments = parser.parse_args()
scene, task, forecaster = TrapperScene(), load_task("trapper"), Forecaster.from_pretrained("trapper")
planner = task.planner("corner", "ik").with_parts(forecaster=forecaster, search=SoftExactSearch(temperature=2.0))


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
    tool_pos = planner.static.arm(joints)[:, :3, 3] + torch.tensor(scene.base_pos)
    return torch.cat([joints, 0.0 * joints, tool_pos], dim=-1), history, paths[ball, now + torch.arange(301)]


def misses(state: Tensor, history: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """How far the ball truly is from the goal at the meeting time [m], and how late the robot [steps], where it can."""
    step_count = torch.full((len(state),), 13)
    seen = Observation(state[:, 12:], truth[:, 0], state, step_count, seen=(history,))
    plan = planner.replan(seen, Plan.hold(seen, length=0))
    there = between(truth, plan.arrival_steps.unsqueeze(-1)).squeeze(-2)
    late = (planner.eta.arrival(state, plan.goal, estimator="soft").steps - plan.arrival_steps).relu()
    return (there - plan.goal)[plan.reachable, :2].norm(dim=-1), late[plan.reachable]


def report(when: str) -> None:
    """Print what is missed in situations that training does not see."""
    miss, late = (figures.detach() for figures in misses(*held_out))
    print(f"{when}: miss {miss.median():.4f} m (median), {late.mean():.2f} steps late")
    if arguments.episodes:
        exact = planner.with_parts(search=ExactSearch())
        print(evaluate(task, {when.strip(): exact}, episodes=arguments.episodes, split="dev", velocity=3.0).table())


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
