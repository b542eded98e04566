"""A forecast that learns, while it runs, how much the target brakes beyond what the forecaster was taught."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d

from torchdyn_plan.checks import check_number, check_trailing_shape


class Course(NamedTuple):
    """What is remembered of the forecast made last, and of how those before it were off."""

    course: Tensor
    """``(*B, T, 2)`` where it saw the target at the plan and in 1 … T - 1 steps, uncorrected [m, world]."""
    course_age: Tensor
    """``(*B,)`` int64 control steps since that plan."""
    drags: Tensor
    """``(*B, M, 2)`` drag along x and y as each of the last M plans found it, NaN where it did not [m/step²]."""


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """Takes what the forecasts of the last plans missed for a *drag*: a deceleration that the forecaster knows not of.

    A target that the forecast of k steps ago has ahead of where it is now, by b along an axis, has a drag of 2b/k²
    (a target that is ahead of the forecast a negative one). The last estimates of both axes are taken together, and
    the drag is their quartile nearer to zero, or zero if the quartiles disagree about the sign: a single surprise
    changes nothing, a rougher cloth does. The forecast is then run slower, axis by axis: with the speed v of the
    forecast at each step, the pace ρ starts at 1 and loses drag/v a step, and the time on the forecast is the sum of
    ρ. As paces do, it survives a bounce; the target stops where it falls to zero.
    """

    memory: int = 8
    """Plans M whose estimates are kept."""
    least: int = 4
    """With fewer estimates than this, of both axes together, there is no drag."""
    quartile: float = 0.25
    """Share of the estimates that lie beyond the one taken, on the side of zero."""
    youngest: int = 3
    """A forecast younger than this is not judged [control steps]."""
    oldest: int = 15
    """A forecast older than this is not judged [control steps]."""
    largest: float = 5e-5
    """A larger estimate is no drag: a bounce or a push [m/step²]."""
    slowest: float = 2e-4
    """Along an axis on which the target is slower than this, it is not judged [m/step]."""
    smooth: int = 4
    """Speeds are the greatest within so many steps, so that a turn at a cushion is no stop."""

    def __post_init__(self) -> None:
        for name in ("memory", "least", "youngest"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        check_number("oldest", self.oldest, minimum=self.youngest, integer=True)
        check_number("smooth", self.smooth, minimum=0, integer=True)
        check_number("quartile", self.quartile, minimum=0.0, maximum=0.5)
        for name in ("largest", "slowest"):
            check_number(name, getattr(self, name), minimum=0.0)

    def start(self, target_pos: Tensor) -> Course:
        """Course of targets ``(*B, 3)`` [m, world] of which nothing is known yet."""
        batch = target_pos.shape[:-1]
        course = target_pos[..., None, :2].expand(*batch, self.oldest + 1, 2)
        age = torch.zeros(batch, dtype=torch.int64, device=target_pos.device)
        return Course(course, age, target_pos.new_full((*batch, self.memory, 2), torch.nan))

    def adapt(self, forecast: Tensor, target_pos: Tensor, course: Course) -> tuple[Tensor, Course]:
        """Forecast with the drag found so far, and the course to remember.

        Args:
            forecast: ``(*B, F, 3)`` [m, world], finite.
            target_pos: ``(*B, 3)`` [m, world], the target now.
            course: of the plan before.

        Returns:
            The corrected forecast, equal to ``forecast`` where there is no drag, and the new course, of age 0.

        Raises:
            InputError: a shape is wrong.
        """
        horizon = forecast.shape[-2] if forecast.ndim > 1 else 1
        check_trailing_shape("forecast", forecast, *target_pos.shape[:-1], horizon, 3)
        found = self.observe(course.course, course.course_age, target_pos)
        drags = torch.cat([course.drags[..., 1:, :], found.unsqueeze(-2)], dim=-2)
        path = torch.cat([target_pos.unsqueeze(-2), forecast], dim=-2)
        kept = torch.arange(self.oldest + 1, device=path.device).clamp(max=horizon)
        slower = slow_down(path, self.drag(drags), smooth=self.smooth)
        return slower, Course(path[..., kept, :2], torch.zeros_like(course.course_age), drags)

    def observe(self, course: Tensor, age: Tensor, target_pos: Tensor) -> Tensor:
        """Drag that the forecast ``course`` (*B, T, 2) [m], made ``age`` (*B,) steps ago, shows: ``(*B, 2)`` [m/step²].

        NaN along an axis on which it turned back or was too slow, for a target below the table, and where the forecast
        is too young, too old, or off by more than a drag can explain.
        """
        judged = (age >= self.youngest) & (age <= self.oldest) & (target_pos[..., 2] > 0.0)
        age = age.clamp(1, course.shape[-2] - 1)[..., None, None]
        way = course.diff(dim=-2)
        direction = way[..., :1, :].sign()
        later = torch.arange(way.shape[-2], device=way.device).unsqueeze(-1) >= age
        straight = ((way * direction > self.slowest) | later).all(-2)
        place = course.gather(-2, age.expand(*age.shape[:-1], 2))
        behind = ((place - target_pos[..., None, :2]) * direction).squeeze(-2)
        drag = 2.0 * behind / age.squeeze(-1).square()
        return torch.where(judged.unsqueeze(-1) & straight & (drag.abs() < self.largest), drag, torch.nan)

    def drag(self, drags: Tensor) -> Tensor:
        """One drag ``(*B,)`` [m/step²] from estimates ``(*B, M, 2)``, NaN for none."""
        ordered = drags.flatten(-2).sort(dim=-1).values
        count = (~ordered.isnan()).sum(-1, keepdim=True)
        from_end = ((count - 1).clamp_min(0) * self.quartile).ceil().to(torch.int64)
        low = ordered.gather(-1, from_end)
        high = ordered.gather(-1, (count - 1 - from_end).clamp_min(0))
        agreed = torch.where(low > 0.0, low, torch.where(high < 0.0, high, 0.0))
        return torch.where(count >= self.least, agreed, 0.0).squeeze(-1)


def slow_down(path: Tensor, drag: Tensor, *, smooth: int = 4) -> Tensor:
    """Positions 1 … F of a path along which the target decelerates by ``drag`` more, ``(*B, F, 3)`` [m, world].

    Along x and y on its own: the time τ on the path is the sum of a pace ρ = 1 - Σ drag/v, and the target stops where
    ρ falls to 0. The height is the one at the smaller of the two times. The end of the path is repeated beyond it.

    Args:
        path: ``(*B, F + 1, 3)`` [m, world], the target now and in 1 … F steps.
        drag: ``(*B,)`` [m/step²]; negative for a target that brakes less.
        smooth: speeds v are the greatest within so many steps.
    """
    horizon, level = path.shape[-2] - 1, path[..., :2].mT
    speed = level.diff(dim=-1).abs().reshape(-1, 2, horizon)
    speed = max_pool1d(speed, 2 * smooth + 1, 1, smooth).reshape(level[..., 1:].shape).clamp_min(1e-5)
    pace = (1.0 - (drag[..., None, None] / speed).cumsum(-1)).clamp_max(2.0)
    # Paces fall but where drag is negative: once stopped, for ever stopped.
    moving = (pace > 0.0).cumprod(-1)
    time = (pace * moving).cumsum(-1).clamp(max=float(horizon))
    before = time.floor().clamp(max=horizon - 1.0)
    index, share = before.to(torch.int64), time - before
    level = torch.lerp(level.gather(-1, index), level.gather(-1, index + 1), share)
    height = path[..., 2].gather(-1, time.amin(-2).round().to(torch.int64))
    return torch.cat([level.mT, height.unsqueeze(-1)], dim=-1)
