"""A task whose recorders count what they are asked for, and whose policy learns in seconds."""

from dataclasses import dataclass

import torch

from tests.envs.points import STRIDE, PointEnv
from tests.training.points import PointTask
from torchdyn_plan.nets import Actor, CaptureConfig, ETAConfig, ForecasterConfig, PolicyConfig
from torchdyn_plan.planners import PolicyPlanner, ProportionalController
from torchdyn_plan.tasks import PolicyTraining, Settings, Task, Words
from torchdyn_plan.training import DDPGRecipe, Fitting, lay_end_to_end

SIZES = PolicyConfig(robot_state_size=3, tool_slice=(0, 3), action_size=3, hidden=8, layers=1)
CAPTURES = CaptureConfig(window=2, stride=1, hidden=16, reach=0.2)


@dataclass(frozen=True, kw_only=True)
class LearnOptions:
    """Of the policy."""

    note: str = "none"
    """Something to say."""


def record_paths(blocks, *, seed, num_threads):
    draws = [
        torch.rand(len(block), 3, generator=torch.Generator().manual_seed(seed + int(block[0]))) for block in blocks
    ]
    start = torch.cat(draws)
    path = start.unsqueeze(1) + 0.01 * torch.arange(40.0).view(-1, 1) * torch.tensor([1.0, 0.0, 0.0])
    return lay_end_to_end(path, start[:, 0])


def record_arrivals(planner, *, num_envs, sequences, seed, num_threads):
    draw = torch.Generator().manual_seed(seed)
    goal = torch.rand(num_envs * sequences, 3, generator=draw)
    arrival = (goal.abs().amax(-1) / STRIDE).ceil().long()
    state = torch.zeros_like(goal) if isinstance(planner, ProportionalController) else torch.ones_like(goal)
    runs = torch.arange(len(goal)) // 2
    return {"robot_state": state, "goal": goal, "arrival": arrival, "nearest": arrival, "run": runs}


def record_captures(static, blocks, *, seed, num_threads):
    """Targets that pass a place at a distance; those within 5 cm are captured, those of `learned` never."""
    count = sum(map(len, blocks))
    draw = torch.Generator().manual_seed(seed)
    goal, away = torch.rand(2, count, 2, generator=draw)
    window = (goal + 0.1 * away).unsqueeze(1).expand(-1, CAPTURES.positions, -1)
    captured = (away[:, 0] < 0.5) & (static == "straight")
    return {"window": window, "goal": goal, "captured": captured, "run": torch.cat(list(blocks))}


def learned(*, chunk=None, weights=None):
    return PolicyPlanner(Actor.from_pretrained(weights) if weights else Actor(SIZES), chunk=chunk)


TASK = Task(
    name="toy",
    summary="Points meet points.",
    settings=Settings,
    words=Words(success="met", steps="steps to meet"),
    max_steps=40,
    control_step=0.1,
    make_env=lambda settings, num_threads, **series: PointEnv(**series),
    digest=lambda: "toy-1",
    static_planners={"straight": lambda chunk, weights: ProportionalController(gain=1.0 / STRIDE), "learned": learned},
    planners={},
    record_paths=record_paths,
    record_arrivals=record_arrivals,
    record_captures=record_captures,
    fitting=lambda: Fitting(
        forecaster=ForecasterConfig(history=4, horizon=10, channels=4, convolutions=1, hidden=8, rank=4),
        eta=ETAConfig(robot_state_size=3, tool_slice=(0, 3), bins=12, bin_width=1, hidden=8),
        capture=CAPTURES,
        spread=True,
    ),
    policies={
        "policy": PolicyTraining(
            summary="Learns to reach.",
            options=LearnOptions,
            goal_task=lambda options, num_threads: PointTask(),
            recipe=lambda: DDPGRecipe(iterations=2, num_envs=4, updates=2, batch=16, capacity=200, warmup=1, gamma=0.9),
            score_every=1,
        )
    },
)
