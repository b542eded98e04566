"""Waiting and dropping: above the meeting place until the box will enclose the target, then down over it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Self

import torch
from torch import Tensor
from torch.func import debug_unwrap

from torchdyn_plan.checks import check_number
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.planners.search.exact import ExactSearch
from torchdyn_plan.tasks.trapper.approach import BoxApproach, metres
from torchdyn_plan.tasks.trapper.keep import is_caught

if TYPE_CHECKING:
    from torchdyn_plan.envs.trapper.scene import TrapperScene


@dataclass(frozen=True, kw_only=True)
class Drop:
    """A spherical target, a square box above it, and how fast a static planner brings the box down.

    Times are control steps, speeds metres per control step. The descent is a static planner's own: these are the
    `IKPlanner`'s, read off drops from rest all over the table.
    """

    radius: float
    """Radius of the target [m]."""
    half_width: float
    """Inner half-width of the box [m]."""
    speed: float = 0.0045
    """Greatest speed of the descent [m/step]."""
    acceleration: float = 0.0005
    """Its acceleration [m/step²]."""
    catch_height: float = 0.070
    """A target that runs into the far wall is held by it when the rim is below this height [m]."""
    give: float = 0.0005
    """A rim that is lower than the top of the target by less than this touches nothing [m]."""
    glide: float = 2.0
    """Steps in which the tool's speed sideways falls to 1/e once it drops."""
    steps: int = 24
    """Steps of a drop that are looked at."""
    choices: int = 8
    """Moments to begin, from now on, that are compared."""
    min_clearance_gain: float = 0.002
    """Clearance that a step of waiting must gain [m/step]."""

    def __post_init__(self) -> None:
        for name in (
            "radius",
            "half_width",
            "speed",
            "acceleration",
            "catch_height",
            "give",
            "glide",
            "min_clearance_gain",
        ):
            check_number(name, getattr(self, name), minimum=0.0)
        for name in ("steps", "choices"):
            check_number(name, getattr(self, name), minimum=1, integer=True)

    @classmethod
    def of(cls, scene: TrapperScene) -> Self:
        """The drop of the box of ``scene`` over its ball."""
        return cls(radius=scene.ball_radius, half_width=scene.box_half_width)

    @property
    def lookahead(self) -> int:
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

    def may_enclose(self, path: Tensor, tool_pos: Tensor, tool_step: Tensor) -> Tensor:
        """A quick look: false where a drop that begins now cannot enclose the target, ``(*B,)`` bool.

        So it is where the target stays outside of the box from now until the drop is over: when the rim comes below its
        top, it is before a near wall, or has met a far one that was too high to hold it. Arguments as for `clearance`.
        """
        if self.catch_height + self.speed >= 2 * self.radius - self.give:
            return torch.ones_like(tool_pos[..., 0], dtype=torch.bool)
        now = self._offset(path[..., : self.steps + 1, :], tool_pos, tool_step)
        return (now.abs().amax(-1) <= self.half_width).any(-1)

    def clearance(self, path: Tensor, tool_pos: Tensor, tool_step: Tensor) -> Tensor:
        """How well a drop that begins in 0, 1, … ``choices`` - 1 steps encloses the target, ``(*B, choices)`` [m].

        Positive where the target is inside the box all the while that the rim is below its top: by the least gap to
        the near walls, or by half of what the rim is below the catch height when the target meets a far wall.
        A drop that does not bring the rim so far down within ``steps`` encloses nothing. The later a drop, the more
        its entry is lowered, by ``min_clearance_gain`` a step, so that the greatest says when to begin.

        Args:
            path: ``(*B, lookahead, 3)`` positions of the target from now on [m, world].
            tool_pos: ``(*B, 3)`` centre of the box mouth [m, world], the box square to the world's axes.
            tool_step: ``(*B, 3)``, how far the tool moved in the last step [m].
        """
        window = self._offset(path, tool_pos, tool_step).unfold(-2, self.steps + 1, 1)[..., : self.choices, :, :].mT
        heading = torch.sign(window[..., -1:, :] - window[..., :1, :])
        # The wall behind a target that rests is the nearest one.
        along = torch.where(heading == 0.0, -window.abs(), window * heading)

        rim = self.descent(tool_pos[..., 2], tool_step[..., 2]).unsqueeze(-2)
        above = (rim - self.radius).clamp(0.0, self.radius)
        # Half the target's width at the height of the rim.
        reach = (self.radius**2 - above.square()).clamp_min(0.0).sqrt()
        low = rim < 2 * self.radius - self.give
        near = (along.amin(-1) + self.half_width - reach).masked_fill(~low, 1.0)
        stopped = along.amax(-1) > self.half_width - reach
        met = stopped.cumsum(-1)
        near = near.masked_fill(met > 0, 1.0).amin(-1).masked_fill(~low.any(-1), -1.0)
        caught_at = torch.where(stopped & (met == 1), rim, 0.0).amax(-1)
        far = torch.where(met[..., -1] > 0, 0.5 * (self.catch_height - caught_at), 1.0)
        later = self.min_clearance_gain * torch.arange(self.choices, device=path.device)
        return torch.minimum(near, far.clamp_max(self.half_width)) - later

    def _offset(self, path: Tensor, tool_pos: Tensor, tool_step: Tensor) -> Tensor:
        """Where the target is from the middle of a box that glides on sideways, ``(*B, T, 2)`` [m], for T positions."""
        time = torch.arange(path.shape[-2], device=path.device, dtype=path.dtype)
        gliding = self.glide * (1.0 - torch.exp(-time / max(self.glide, 1e-9)))
        return path[..., :2] - tool_pos[..., None, :2] - tool_step[..., None, :2] * gliding.unsqueeze(-1)


class DropState(NamedTuple):
    """Where each row's drop stands."""

    drop_step: Tensor
    """``(*B,)`` int64 control steps since the drop began, -1 for none."""
    tool_before: Tensor
    """``(*B, 3)`` the tool a step ago [m, world]."""


@dataclass(frozen=True, kw_only=True)
class WaitAndDrop:
    """A maneuver: wait above the meeting place, drop when the box will enclose the target, lift if it was missed.

    `Drop` says at every step, on the newest forecast, whether to begin now. The box first goes straight down, then
    follows the target until it has caught it. The static planner hears of all that through the goal alone. Rows that
    cannot plan hold still and begin no drop on what they knew before; one that has begun goes on.
    """

    drop: Drop
    """Sizes, and the descent of the static planner."""
    drop_height: float
    """Height of a goal that brings the box down [m]."""
    half_extent: float
    """Goals of a dropping box are clamped to the square of this half-side [m]."""
    pull: float = 0.044
    """The goal of a dropping box is at most so far from it, sideways: within an approach's drop distance [m]."""
    aim_ahead_steps: int = 7
    """A box that follows is sent to where the target will be in so many steps: what the static planner lags behind,
    and more."""
    follow_after: int = 2
    """Control steps that a box goes straight down before it follows the target."""
    begin_above: float = 0.95
    """A drop begins only above this share of the target's height: a box that is lower would push it."""
    down_below: float = 0.6
    """A box is down below this share of the target's height."""
    missed_by: float = 0.01
    """A target this far outside of the box's inner walls was missed [m]."""
    min_drop_steps: int = 8
    """For so many control steps a drop is not given up: the box is on its way down."""
    max_drop_steps: int = 40
    """After so many control steps a drop over a target outside is given up, whatever the box's height."""

    State: ClassVar[type[DropState]] = DropState

    def __post_init__(self) -> None:
        check_number("aim_ahead_steps", self.aim_ahead_steps, minimum=0, maximum=self.lookahead - 1, integer=True)
        for name in ("follow_after", "min_drop_steps", "max_drop_steps"):
            check_number(name, getattr(self, name), minimum=0, integer=True)
        for name in ("drop_height", "pull", "half_extent", "begin_above", "down_below", "missed_by"):
            check_number(name, getattr(self, name), minimum=0.0)

    @classmethod
    def of(cls, scene: TrapperScene) -> Self:
        """The maneuver with the box, the ball and the table of ``scene``."""
        half_extent = BoxApproach.of(scene).half_extent
        return cls(drop=Drop.of(scene), drop_height=scene.ball_radius, half_extent=half_extent)

    @property
    def lookahead(self) -> int:
        """Positions of the target's path that a drop looks at."""
        return self.drop.lookahead

    def start(self, observation: Observation) -> DropState:
        """No drop."""
        return DropState(torch.full_like(observation.step_count, -1), observation.tool_pos)

    def __call__(
        self, plan: Plan, observation: Observation, holds: Tensor, state: DropState
    ) -> tuple[Tensor, DropState]:
        """Above the meeting place, or down: first where the tool is, then after the target."""
        tool_pos, lookahead = observation.tool_pos, self.drop.steps + self.drop.choices
        path = plan.ahead(lookahead)
        drop_step = torch.where(state.drop_step >= 0, state.drop_step + 1, state.drop_step)
        # When plans stay away, what is known of the path ends too soon to begin a drop.
        known = (plan.age >= 0) & (plan.age + lookahead <= plan.path.shape[-2])
        may_begin = (drop_step < 0) & known & ~holds
        above = tool_pos[..., 2] > self.begin_above * 2 * self.drop.radius
        tool_step = tool_pos - state.tool_before
        may_begin = may_begin & above & self.drop.may_enclose(path, tool_pos, tool_step)
        if torch.compiler.is_compiling() or debug_unwrap(may_begin).any():
            clearance = self.drop.clearance(path, tool_pos, tool_step)
            best = (clearance.argmax(-1) == 0) & (clearance[..., 0] > 0.0)
            # The table's top is at z = 0: a ball that is expected below falls into a pocket.
            on_table = (path[..., 2] > 0.0).all(-1)
            drop_step = drop_step.masked_fill(may_begin & best & on_table, 0)
        goal = plan.goal
        if torch.compiler.is_compiling() or debug_unwrap(drop_step >= 0).any():
            drop_step = drop_step.masked_fill(self._has_missed(drop_step, observation), -1)
            goal = torch.where((drop_step >= 0).unsqueeze(-1), self._goal(drop_step, path, observation), goal)
        return goal, DropState(drop_step, tool_pos)

    def _has_missed(self, drop_step: Tensor, observation: Observation) -> Tensor:
        """Whether the target is outside of a box that is down, or should be: ``(*B,)`` bool."""
        offset = (observation.target_pos - observation.tool_pos)[..., :2].abs().amax(-1)
        down = observation.tool_pos[..., 2] < self.down_below * 2 * self.drop.radius
        over = (drop_step > self.min_drop_steps) & (down | (drop_step > self.max_drop_steps))
        return over & (offset > self.drop.half_width + self.missed_by)

    def _goal(self, drop_step: Tensor, path: Tensor, observation: Observation) -> Tensor:
        """Goal ``(*B, 3)`` [m, world] of a box that drops."""
        tool_pos, target_pos = observation.tool_pos, observation.target_pos
        level = tool_pos[..., :2]
        # The forecast knows of no box, and goes on through its wall: a box that followed it would let the ball out.
        caught = is_caught(tool_pos, target_pos, radius=self.drop.radius, half_width=self.drop.half_width)
        follow = ((drop_step >= self.follow_after) & ~caught).unsqueeze(-1)
        down = torch.where(follow, pulled(level, path[..., self.aim_ahead_steps, :2], self.pull), level)
        down = down.clamp(-self.half_extent, self.half_extent)
        return torch.cat([down, torch.full_like(down[..., :1], self.drop_height)], dim=-1)


def pulled(level: Tensor, place: Tensor, pull: float) -> Tensor:
    """``place`` (*B, 2), or the point on the way there that is ``pull`` away from ``level`` (*B, 2) [m, world]."""
    way = place - level
    length = way.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-9)
    return level + way * (length.clamp_max(pull) / length)


def waiting_search(scene: TrapperScene, *, by_probability: bool = True, by_capture: bool = False) -> ExactSearch:
    """Meets the ball of ``scene`` with the rim 2 cm above it, as far out as the rails let the box stand.

    Rather not close to the arm's axis, where a drop takes twice as long. ``by_probability`` also weighs how likely a
    meeting is, by the spread of the forecast and the distribution of the arrival time; then less margin is needed. It
    weighs more ``by_capture``, where the probability of a capture is known, too.
    """
    approach, weight = BoxApproach.of(scene), 60.0 if by_capture else 30.0
    return ExactSearch(
        height=metres(2 * scene.ball_radius + 0.021),
        half_extent=approach.half_extent,
        descent_steps=7.0,
        footprint=metres(scene.box_half_width - 0.01),
        longest_dwell=12,
        waiting_cost=0.01,
        switching_cost=8.0,
        arrival_radius=0.015,
        base_pos=approach.base_pos[:2],
        probability_weight=weight if by_probability else 0.0,
        margin=5.0 if by_probability else 15.0,
    )
