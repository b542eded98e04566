"""When to let a box down over a moving target: its rim's descent against the target's path, step by step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number


@dataclass(frozen=True, kw_only=True)
class Drop:
    """A spherical target, a square box above it, and how fast a static planner brings the box down.

    Times are control steps, speeds metres per control step. The descent is a static planner's own: these are the
    `IKPlanner`'s, read off drops from rest all over the table.
    """

    radius: float = 0.042
    """Radius of the target [m]."""
    half_width: float = 0.065
    """Inner half-width of the box [m]."""
    speed: float = 0.0045
    """Greatest speed of the descent [m/step]."""
    acceleration: float = 0.0005
    """Its acceleration [m/step²]."""
    catch_height: float = 0.070
    """A target that runs into the far wall is held by it when the rim is below this height [m]."""
    glide: float = 2.0
    """Steps in which the tool's speed sideways falls to 1/e once it drops."""
    steps: int = 24
    """Steps of a drop that are looked at."""
    choices: int = 8
    """Moments to begin, from now on, that are compared."""
    hurry: float = 0.002
    """Clearance that a step of waiting must gain [m/step]."""

    def __post_init__(self) -> None:
        for name in ("radius", "half_width", "speed", "acceleration", "catch_height", "glide", "hurry"):
            check_number(name, getattr(self, name), minimum=0.0)
        for name in ("steps", "choices"):
            check_number(name, getattr(self, name), minimum=1, integer=True)

    @property
    def outlook(self) -> int:
        """Positions of the target that `clearance` looks at, the present one included."""
        return self.steps + self.choices

    def descent(self, height: Tensor, speed: Tensor) -> Tensor:
        """Heights of the rim 0 … ``steps`` steps after a drop begins, ``(*B, steps + 1)`` [m].

        Args:
            height: ``(*B,)`` of the rim when it begins [m].
            speed: ``(*B,)`` of the rim upwards when it begins [m/step].
        """
        time = torch.arange(self.steps + 1, device=height.device, dtype=height.dtype)
        faster = (time - 1.0).clamp_min(0.0) * self.acceleration
        change = (speed.unsqueeze(-1) - faster).clamp_min(-self.speed) * (time > 0)
        return (height.unsqueeze(-1) + change.cumsum(-1)).clamp_min(self.radius)

    def clearance(self, path: Tensor, tool_pos: Tensor, tool_step: Tensor) -> Tensor:
        """How well a drop that begins in 0, 1, … ``choices`` - 1 steps encloses the target, ``(*B, choices)`` [m].

        Positive where the target is inside the box all the while that the rim is below its top: by the least gap to
        the near walls, or by half of what the rim is below the catch height when the target meets a far wall.
        A drop that does not bring the rim so far down within ``steps`` encloses nothing. The later a drop, the more
        its entry is lowered, by ``hurry`` a step, so that the greatest says when to begin.

        Args:
            path: ``(*B, outlook, 3)`` positions of the target from now on [m, world].
            tool_pos: ``(*B, 3)`` centre of the box mouth [m, world], the box square to the world's axes.
            tool_step: ``(*B, 3)``, how far the tool moved in the last step [m].
        """
        time = torch.arange(self.outlook, device=path.device, dtype=path.dtype)
        gliding = self.glide * (1.0 - torch.exp(-time / max(self.glide, 1e-9)))
        offset = path[..., :2] - tool_pos[..., None, :2] - tool_step[..., None, :2] * gliding.unsqueeze(-1)
        window = offset.unfold(-2, self.steps + 1, 1)[..., : self.choices, :, :].mT
        heading = torch.sign(window[..., -1:, :] - window[..., :1, :])
        # The wall behind a target that rests is the nearest one.
        along = torch.where(heading == 0.0, -window.abs(), window * heading)

        rim = self.descent(tool_pos[..., 2], tool_step[..., 2]).unsqueeze(-2)
        above = (rim - self.radius).clamp(0.0, self.radius)
        # Half the target's width at the height of the rim.
        reach = (self.radius**2 - above.square()).clamp_min(0.0).sqrt()
        low = rim < 2 * self.radius - 5e-4
        near = (along.amin(-1) + self.half_width - reach).masked_fill(~low, 1.0)
        stopped = along.amax(-1) > self.half_width - reach
        met = stopped.cumsum(-1)
        near = near.masked_fill(met > 0, 1.0).amin(-1).masked_fill(~low.any(-1), -1.0)
        caught_at = torch.where(stopped & (met == 1), rim, 0.0).amax(-1)
        far = torch.where(met[..., -1] > 0, 0.5 * (self.catch_height - caught_at), 1.0)
        later = self.hurry * torch.arange(self.choices, device=path.device)
        return torch.minimum(near, far.clamp_max(self.half_width)) - later
