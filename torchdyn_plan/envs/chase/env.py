"""A base on wheels is to meet somebody who walks: a plane, two limits, and nothing between the two."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.episodes import draw_uniform
from torchdyn_plan.envs.look import TARGET, TOOL, Ball, Look, bare_floor
from torchdyn_plan.envs.moving_target import MovingTargetEnv, RobotReading

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True, kw_only=True)
class ChaseWorld:
    """The base and where walkers start; it starts at rest in the origin."""

    base_speed: float = 1.5
    """Greatest speed of the base, in any direction [m/s]."""
    base_acceleration: float = 1.5
    """Greatest acceleration of the base, in any direction [m/s²]."""
    radius: float = 0.3
    """Within this distance base and walker have met [m]."""
    nearest: float = 1.5
    """Walkers start no nearer to the base than this [m]."""
    farthest: float = 4.5
    """Walkers start no farther from the base than this [m]."""
    control_step: float = 0.02
    """Time between two actions [s]."""
    max_steps: int = 450
    """Control steps of an episode."""

    def __post_init__(self) -> None:
        for name in ("base_speed", "base_acceleration", "radius", "control_step"):
            check_number(name, getattr(self, name), minimum=1e-6)
        check_number("nearest", self.nearest, minimum=0.0)
        check_number("farthest", self.farthest, minimum=self.nearest)
        check_number("max_steps", self.max_steps, minimum=1, integer=True)

    def digest(self) -> str:
        """Hash of every number above: two worlds with one digest are one world."""
        text = json.dumps(dataclasses.asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True, kw_only=True, eq=False)
class Walks:
    """How M people walk: at a constant speed, straight on or always turning."""

    start: Tensor
    """``(M, 2)`` [m]."""
    heading: Tensor
    """``(M,)`` at the start [rad]."""
    turning: Tensor
    """``(M,)`` [rad/s], to the left if positive."""
    speed: float
    """[m/s]."""

    @classmethod
    def draw(cls, world: ChaseWorld, episodes: Tensor, *, speed: float, turning: float, split: str, seed: int) -> Walks:
        """Those of ``episodes`` (M,), who turn by ``turning`` [deg/s] to either side; a function of their numbers."""
        # Their distance, bearing, heading and side, within ±1 each.
        distance, bearing, heading, side = draw_uniform(episodes, 4, split=split, seed=seed).unbind(-1)
        away = world.nearest + 0.5 * (distance + 1.0) * (world.farthest - world.nearest)
        start = away.unsqueeze(-1) * direction(math.pi * bearing)
        rate = math.radians(turning) * torch.where(side < 0.0, -1.0, 1.0)
        return cls(start=start, heading=math.pi * heading, turning=rate, speed=speed)

    def at(self, time: Tensor) -> Tensor:
        """Places ``(M, 2)`` float32 at moments ``time`` (M,) [s], or ``(M, T, 2)`` at (M, T).

        A walk that turns by φ is a chord of length v t sin(φ/2) / (φ/2), in the direction half-way.
        """
        shape = (-1, *[1] * (time.ndim - 1))
        half = 0.5 * self.turning.view(shape) * time
        chord = self.speed * time * torch.sinc(half / math.pi)
        way = chord.unsqueeze(-1) * direction(self.heading.view(shape) + half)
        return (self.start.view(len(self.start), *shape[1:], 2) + way).float()


def direction(angle: Tensor) -> Tensor:
    """Unit vectors ``(*B, 2)`` of angles (*B,) [rad]."""
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


class ChaseEnv(MovingTargetEnv):
    """A base with commanded velocity meets a walker; an action of size 1 is its maximum speed.

    The base changes its velocity as fast as it may until it has the one it is told, in a straight line between the two.
    ``robot_state`` is its place [m] and its velocity [m/s]. Plain tensors: thousands of episodes side by side.
    """

    flags = ("met",)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        speed: float = 1.0,
        turning: float = 0.0,
        world: ChaseWorld | None = None,
        **series: Any,
    ) -> None:
        """Walkers go at ``speed`` [m/s] and turn by ``turning`` [deg/s]; ``series`` as of `MovingTargetEnv`."""
        check_number("speed", speed, minimum=0.0)
        check_number("turning", turning, minimum=0.0)
        world = ChaseWorld() if world is None else world
        fixed: dict[str, Any] = {
            "control_step": world.control_step,
            "max_steps": world.max_steps,
            "history": 8,
        }
        super().__init__(num_envs, state_size=4, action_size=2, coordinates=2, **(fixed | series))
        # A walker that is to rest stands still.
        self.world, self.speed, self.turning = world, 0.0 if self.static_target else speed, turning
        self.scene_digest = world.digest()
        self.tool_pos, self.velocity = torch.zeros(2, num_envs, 2).unbind(0)
        self.walks = self._draw(torch.zeros(num_envs, dtype=torch.int64))

    def _draw(self, episodes: Tensor) -> Walks:
        how: dict[str, Any] = {"speed": self.speed, "turning": self.turning, "split": self.split, "seed": self.seed}
        return Walks.draw(self.world, episodes, **how)

    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        drawn = self._draw(episodes)
        for name in ("start", "heading", "turning"):
            getattr(self.walks, name)[rows] = getattr(drawn, name)
        self.tool_pos, self.velocity = (value.index_fill(0, rows, 0.0) for value in (self.tool_pos, self.velocity))
        return drawn.start.float()

    def _advance(self, action: Tensor) -> Tensor:
        world = self.world
        told = world.base_speed * action / action.norm(dim=-1, keepdim=True).clamp_min(1.0)
        change, most = told - self.velocity, world.base_acceleration * world.control_step
        change = change * (most / change.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp(max=1.0)
        self.tool_pos = self.tool_pos + world.control_step * (self.velocity + 0.5 * change)
        self.velocity = self.velocity + change
        return self.walks.at(world.control_step * (self.step_count + 1))

    def _robot(self) -> RobotReading:
        return RobotReading(self.tool_pos, torch.cat([self.tool_pos, self.velocity], dim=-1))

    def _flags(self) -> dict[str, Tensor]:
        return {"met": (self.tool_pos - self.target_pos).norm(dim=-1) <= self.world.radius}

    def true_future(self, rows: Tensor, steps: int) -> Tensor:
        """As of `MovingTargetEnv`: nobody is disturbed by the base."""
        ahead = torch.arange(1, steps + 1) + self.step_count[rows].unsqueeze(-1)
        walks = self.walks
        chosen = Walks(
            start=walks.start[rows], heading=walks.heading[rows], turning=walks.turning[rows], speed=walks.speed
        )
        return chosen.at(self.world.control_step * ahead)

    def look(self) -> Look:
        """As of `MovingTargetEnv`: base and walker are balls of the size that counts as met."""
        world = self.world
        half_side = world.farthest + 1.5
        return Look(
            bare_floor(half_side),
            distance=2.4 * half_side,
            azimuth=90.0,
            elevation=-70.0,
            half_side=half_side,
            tool=Ball(world.radius, TOOL),
            target=Ball(0.6 * world.radius, TARGET),
        )

    def _picture(self, row: int, width: int, height: int) -> np.ndarray[Any, Any]:
        from torchdyn_plan.envs.chase.picture import draw_world

        return draw_world(self.world, self.tool_pos[row], self.target_pos[row], width, height)
