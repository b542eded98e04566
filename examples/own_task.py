"""Your own task in one file: a catcher with a speed limit meets a drone that bounces about a room.

From the folder above this one, and with any task of yours in the same way:
    torchdyn-plan collect paths --task examples.own_task:TASK --out runs/catch --episodes 500
    torchdyn-plan collect arrivals --task examples.own_task:TASK --out runs/catch --episodes 64 --num-envs 64
    torchdyn-plan train forecaster --task examples.own_task:TASK --data runs/catch --out runs/catch
    torchdyn-plan train eta --task examples.own_task:TASK --data runs/catch --out runs/catch
    torchdyn-plan evaluate --task examples.own_task:TASK --weights runs/catch
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.envs import EnvRunner, MovingTargetEnv, RobotReading, draw_uniform
from torchdyn_plan.nets import ETAConfig, ForecasterConfig
from torchdyn_plan.nets.reflection import reflect
from torchdyn_plan.planners import DynamicPlanner, ExactSearch, ProportionalController, ReplanSchedule, TargetPursuit
from torchdyn_plan.tasks import PlannerParts, Settings, Task, Words, setting
from torchdyn_plan.training import Fitting, Recipe, RunPlan, WindowConfig, lay_end_to_end, record_runs

ROOM, HEIGHT = 1.0, 0.5  # |x| and |y| of the walls, and how high everything flies [m]
START = torch.tensor([0.0, -ROOM, HEIGHT])
STEP, PATH_STEPS = 0.05, 200  # control step [s], and how many of them a drone is followed for
SPEED_LIMIT, RADIUS = 0.5, 0.06  # of the catcher [m/s], and how near is caught [m]


@dataclass(frozen=True, kw_only=True)
class CatchSettings(Settings):
    """What varies from run to run: the options of `torchdyn-plan evaluate`, and what a sweep goes over."""

    speed: float = setting(1.0, text="Speed of the drone", unit="m/s", minimum=0.0, maximum=4.0, sweep=(0.5, 1.0, 1.5))


def fly(episodes: Tensor, speed: float | Tensor, *, split: str, seed: int) -> Tensor:
    """Places ``(M, PATH_STEPS, 3)`` of drones [m]: lines that walls reflect, a function of the episodes' numbers."""
    drawn = draw_uniform(episodes, 3, split=split, seed=seed).float().unsqueeze(1)
    heading, way = torch.pi * drawn[..., 2], speed * STEP * torch.arange(PATH_STEPS)
    line = ROOM * drawn[..., :2] + torch.stack([way * heading.cos(), way * heading.sin()], dim=-1)
    return torch.nn.functional.pad(reflect(line, ROOM), (0, 1), value=HEIGHT)


class CatchEnv(MovingTargetEnv):
    """A point flies where its action points, at a limited speed, until it is near the drone."""

    flags = ("caught",)

    def __init__(self, num_envs: int = 1, *, speed: float = 1.0, **series: Any) -> None:
        super().__init__(num_envs, state_size=3, action_size=3, history=8, max_steps=100, **series)
        self.speed, self.paths = speed, torch.zeros(num_envs, PATH_STEPS, 3)
        self.tool_pos = START.repeat(num_envs, 1)

    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        self.paths[rows] = fly(episodes, self.speed, split=self.split, seed=self.seed)
        self.tool_pos = self.tool_pos.index_copy(0, rows, START.repeat(len(rows), 1))
        return self.paths[rows, 0]

    def _advance(self, action: Tensor) -> Tensor:
        self.tool_pos = self.tool_pos + SPEED_LIMIT * STEP * action / action.norm(dim=-1, keepdim=True).clamp_min(1.0)
        return self.paths[torch.arange(self.num_envs), (self.step_count + 1).clamp(max=PATH_STEPS - 1)]

    def _robot(self) -> RobotReading:
        return RobotReading(self.tool_pos, state=self.tool_pos)

    def _flags(self) -> dict[str, Tensor]:
        return {"caught": (self.tool_pos - self.target_pos).norm(dim=-1) < RADIUS}


def intercept(parts: PlannerParts) -> DynamicPlanner:
    """Plans a meeting every four control steps."""
    how: dict[str, Any] = {"search": ExactSearch(stride=2, first=2), "schedule": ReplanSchedule.every(4, first_step=2)}
    return DynamicPlanner(parts.static, parts.forecaster, parts.eta, chunk=parts.chunk, **how).eval()


def record_paths(blocks: list[Tensor], *, seed: int, num_threads: int) -> dict[str, Tensor]:
    """What a forecaster learns from: drones of all speeds, nobody after them."""
    episodes = torch.cat(blocks)
    draw = torch.Generator().manual_seed(seed + int(episodes[0]))
    speed = 2.0 * torch.rand(len(episodes), 1, generator=draw)
    return lay_end_to_end(fly(episodes, speed, split="train", seed=seed), speed.squeeze(-1))


def record_arrivals(planner: Any, *, num_envs: int, sequences: int, seed: int, num_threads: int) -> dict[str, Tensor]:
    """What an arrival-time network learns from: catchers sent all over the room by the static planner."""

    def goals(count: int, draw: torch.Generator) -> Tensor:
        level = ROOM * (2.0 * torch.rand(count, 2, generator=draw) - 1.0)
        return torch.nn.functional.pad(level, (0, 1), value=HEIGHT)

    plan = RunPlan(goals=goals, sequence=PATH_STEPS, longest=120, redirected_within=40)
    return record_runs(EnvRunner(planner, CatchEnv(num_envs), radius=RADIUS), plan, sequences=sequences, seed=seed)


def fitting() -> Fitting:
    """Small networks, quickly fitted; the forecaster is told of the walls and of the room's symmetry."""
    room: dict[str, Any] = {"half_extent": ROOM, "square_symmetry": True, "history": 8, "horizon": 100}
    sizes: dict[str, Any] = {"channels": 8, "convolutions": 2, "hidden": 64, "rank": 16, "step_scale": 0.1}
    eta = ETAConfig(robot_state_size=3, tool_slice=(0, 3), bins=60, bin_width=2, hidden=64)
    recipes = {"forecaster": Recipe(steps=100, batch=256, lr=2e-3), "eta": Recipe(steps=500, batch=256, lr=2e-3)}
    forecaster, windows = ForecasterConfig(**room, **sizes), WindowConfig(first_step=2)
    return Fitting(forecaster=forecaster, eta=eta, windows=windows, recipes=recipes)


TASK = Task(
    name="catch",
    summary="A catcher with a speed limit meets a drone that bounces about a room.",
    settings=CatchSettings,
    words=Words(success="caught", steps="steps to catch", target="drone"),
    max_steps=100,
    control_step=STEP,
    make_env=lambda settings, num_threads, **series: CatchEnv(speed=settings.speed, **series),
    digest=lambda: "catch-1",  # another one whenever the world changes: older data and weights do not fit it
    static_planners={"straight": lambda chunk, weights: ProportionalController(gain=1.0 / (SPEED_LIMIT * STEP))},
    planners={"pursuit": lambda parts: TargetPursuit(parts.static).eval(), "intercept": intercept},
    record_paths=record_paths,
    record_arrivals=record_arrivals,
    fitting=fitting,
)
