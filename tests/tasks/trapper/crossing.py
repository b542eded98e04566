"""Targets that cross a table, a tool that does what it is told, and a planner that waits and drops, all toys."""

import torch
from tensordict import TensorDict

from tests.planners.toy import HISTORY, SPEED, Straight, StraightArrival, go_straight
from torchdyn_plan.planners import DynamicPlanner, ExactSearch, LostBelow, ReplanSchedule
from torchdyn_plan.tasks.trapper.wait_and_drop import Drop, WaitAndDrop

TABLE, ABOVE = 0.042, 0.105
SEARCH = ExactSearch(
    height=ABOVE, half_extent=0.7, margin=15.0, footprint=0.055, switching_cost=8.0, arrival_radius=0.015
)
DROP = Drop(radius=TABLE, half_width=0.065, speed=SPEED, acceleration=SPEED, glide=0.0)
"""The toy's tool is at its speed in the step after next."""


MANEUVER = WaitAndDrop(drop=DROP, drop_height=TABLE, half_extent=0.7, aim_ahead_steps=3, pull=0.03)
POCKETED = LostBelow(seen_below=-0.042, forecast_below=0.0)


class Sometimes(Straight):
    """Forecaster that fails in the rows whose target is at y < 0 while ``broken`` holds a value."""

    broken = None

    def path(self, history):
        path = super().path(history)
        if self.broken is None:
            return path
        bad = (history[:, -1, 1] < 0).nonzero().squeeze(-1)
        path[bad, 7, 1] = self.broken
        return path


def make_planner(**settings):
    parts = {
        "search": SEARCH,
        "schedule": ReplanSchedule.every(5, first_step=13),
        "maneuver": MANEUVER,
        "lost": POCKETED,
    }
    return DynamicPlanner(go_straight(), Sometimes(horizon=150), StraightArrival(), **(parts | settings))


class World:
    """A tool that does what it is told, and targets that go straight; ``velocity`` may be changed on the way."""

    def __init__(self, start, velocity, tool):
        self.velocity, self.tool = velocity, tool
        self.trace = start.unsqueeze(-2) + velocity.unsqueeze(-2) * torch.arange(1 - HISTORY, 1)[:, None]
        self.step_count = torch.zeros(start.shape[:-1], dtype=torch.int64)

    def show(self, plan=None):
        """What a planner is shown at this step; ``plan`` is its memory."""
        entries = {
            "robot_state": self.tool,
            "tool_pos": self.tool,
            "target_pos": self.trace[..., -1, :],
            "target_history": self.trace,
            "step_count": self.step_count,
        }
        td = TensorDict(entries, self.step_count.shape)
        return td if plan is None else td.set("plan", plan)

    def run(self, planner, steps, plan=None):
        """What the planner wrote at each step."""
        found = []
        for _ in range(steps):
            td = self.show(plan)
            found.append(planner(td).clone())
            plan = found[-1]["plan"]
            self.tool = self.tool + SPEED * td["action"]
            self.trace = torch.cat([self.trace[..., 1:, :], self.trace[..., -1:, :] + self.velocity.unsqueeze(-2)], -2)
            self.step_count = self.step_count + 1
        return found


def world(*batch, seed=0, dtype=torch.float32):
    """Targets that cross the middle of the table, and tools above it."""
    generator = torch.Generator().manual_seed(seed)
    start, velocity, tool = 0.1 * torch.randn(3, *batch, 3, generator=generator, dtype=dtype)
    start[..., 0], velocity = start[..., 0] - 0.3, 0.005 * velocity
    velocity[..., 0] += 0.004
    start[..., 2], velocity[..., 2], tool[..., 2] = TABLE, 0.0, 0.12
    return World(start, velocity, tool)


def line():
    return World(torch.tensor([-0.4, 0.1, TABLE]), torch.tensor([0.004, 0.0, 0.0]), torch.tensor([0.0, 0.0, 0.12]))
