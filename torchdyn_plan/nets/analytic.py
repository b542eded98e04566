"""Forecasts by mechanics, without training; usable wherever a forecaster is expected."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number, check_points, check_trailing_shape, check_vector
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.distributions import Spread
from torchdyn_plan.nets.forecast import Forecast, ForecastModel
from torchdyn_plan.precision import at_least_float32

MEDIAN = 0.6744897501960817
"""Half of a normal distribution's errors are smaller than this many standard deviations."""
SHAPE = math.log(19.0) / math.log(1.959963984540054 / MEDIAN)
"""With this shape a `Spread` has half of its errors and 95 % of them where a normal distribution has them."""
LOOK_BACK = 8
"""Control steps over which a target's loss of speed is judged."""
FINEST = 1e-5
"""Standard deviations of forecasts are taken for no smaller than this [m]."""


class AnalyticForecast(ForecastModel):
    """A forecast by a law of motion, from where a target is and how fast it moves.

    The speed is that of the last step of the history, which a `torchdyn_plan.planners.Track` makes smooth. The spread
    follows from how well both are known, and from what may accelerate the target beside the law.
    """

    def __init__(
        self,
        *,
        horizon: int = 300,
        control_step: float = 0.004,
        tracked: bool = False,
        noise: float = 1e-5,
        acceleration: float = 0.1,
    ) -> None:
        """Forecast ``horizon`` control steps of ``control_step`` [s].

        Args:
            horizon: steps F.
            control_step: time between two steps [s].
            tracked: read ``target_covariance``, as a track tells it; else every position in the history is taken to
                have the error ``noise`` of its own.
            noise: standard deviation of that error along each axis [m].
            acceleration: standard deviation of a constant acceleration along each axis that the law leaves out [m/s²].
        """
        super().__init__()
        check_number("horizon", horizon, minimum=1, integer=True)
        check_number("control_step", control_step, minimum=1e-6)
        check_number("noise", noise, minimum=0.0)
        check_number("acceleration", acceleration, minimum=0.0)
        self.horizon, self.control_step, self.tracked = horizon, control_step, tracked
        self.noise, self.acceleration = noise, acceleration
        self.in_keys: Sequence[Any] = (keys.TARGET_HISTORY, *((keys.TARGET_COVARIANCE,) if tracked else ()))

    @abstractmethod
    def follow(self, history: Tensor, velocity: Tensor, time: Tensor, deviation: Tensor) -> Forecast:
        """The forecast at moments ``time`` (F,) from now [s].

        Args:
            history: ``(*B, H, D)``, the target now last [m, world].
            velocity: ``(*B, D)`` over the last step [m/s, world].
            time: ``(F,)`` [s].
            deviation: ``(*B, F)`` standard deviation along each axis of what both lead to [m].
        """

    def predict(self, *seen: Tensor) -> Forecast:
        """Path and spread after histories ``(*B, H, D)`` [m, world], and of the history's type."""
        history = seen[0]
        check_points(keys.TARGET_HISTORY, history, history.shape[-2] if history.ndim > 1 else 2)
        history = at_least_float32(history)
        place, velocity = history[..., -1, :], (history[..., -1, :] - history[..., -2, :]) / self.control_step
        time = self.control_step * torch.arange(1, self.horizon + 1, dtype=history.dtype, device=history.device)
        path, spread = self.follow(history, velocity, time, self._deviation(time, seen[1:], place))
        return Forecast(path.to(seen[0].dtype), spread)

    def part_settings(self) -> dict[str, Any]:
        """Arguments that make the same model."""
        names = ("horizon", "control_step", "tracked", "noise", "acceleration")
        return {name: getattr(self, name) for name in names}

    def _deviation(self, time: Tensor, covariance: Sequence[Tensor], place: Tensor) -> Tensor:
        """Standard deviation ``(*B, F)`` at moments ``time`` (F,) [s], along each axis [m]."""
        if covariance:
            check_trailing_shape(keys.TARGET_COVARIANCE, covariance[0], 2, 2)
            of_place, both, of_speed = (
                covariance[0].to(time.dtype)[..., row, column, None] for row, column in ((0, 0), (0, 1), (1, 1))
            )
        else:
            of_place = place.new_full((*place.shape[:-1], 1), self.noise**2)
            both, of_speed = of_place / self.control_step, 2.0 * of_place / self.control_step**2
        variance = of_place + 2.0 * time * both + time.square() * of_speed
        left_out = (0.5 * self.acceleration * time.square()).square()
        return (variance + left_out).clamp_min(FINEST**2).sqrt()


class ConstantVelocity(AnalyticForecast):
    """The target keeps its velocity."""

    def follow(self, history: Tensor, velocity: Tensor, time: Tensor, deviation: Tensor) -> Forecast:
        """As of `AnalyticForecast`."""
        path = history[..., -1:, :] + velocity.unsqueeze(-2) * time.unsqueeze(-1)
        return Forecast(path, normal_spread(deviation.unsqueeze(-1).expand(*deviation.shape, 2)))


class Ballistic(AnalyticForecast):
    """The target flies: it falls with a constant acceleration, and nothing else acts on it."""

    def __init__(self, *, gravity: Sequence[float] = (0.0, 0.0, -9.81), **settings: Any) -> None:
        """Fall with ``gravity``, D numbers [m/s², world]; ``settings`` are those of `AnalyticForecast`."""
        super().__init__(**settings)
        self.gravity = check_vector("gravity", gravity)

    def follow(self, history: Tensor, velocity: Tensor, time: Tensor, deviation: Tensor) -> Forecast:
        """As of `AnalyticForecast`."""
        if len(self.gravity) != history.shape[-1]:
            raise InputError(f"gravity has {len(self.gravity)} numbers, but targets {history.shape[-1]} coordinates")
        falls, moment = time.new_tensor(self.gravity), time.unsqueeze(-1)
        # The velocity over the last step is that of half a step ago.
        speed = velocity + 0.5 * self.control_step * falls
        path = history[..., -1:, :] + moment * speed.unsqueeze(-2) + 0.5 * moment.square() * falls
        return Forecast(path, normal_spread(deviation.unsqueeze(-1).expand(*deviation.shape, 2)))

    def part_settings(self) -> dict[str, Any]:
        """Arguments that make the same model."""
        return super().part_settings() | {"gravity": self.gravity}


class Rolled(NamedTuple):
    """Where a ball is along each of two axes between cushions, at F moments."""

    place: Tensor
    """``(*B, F, 2)`` [m]."""
    bounces: Tensor
    """``(*B, F, 2)`` how often it has met a cushion."""
    share: Tensor
    """``(*B, F, 2)`` of its speed that is left."""
    since: Tensor
    """``(*B, F, 2)`` how far it has come since its first bounce [m]."""


class Billiard(AnalyticForecast):
    """The target rolls on a level table between four cushions, which mirror its path and take some of its speed.

    Where a cushion has a gap, the target falls through: its path goes on at ``gone_height``, and the spread says how
    likely that is.
    """

    def __init__(
        self,
        half_extent: float | Sequence[float],
        *,
        restitution: float = 0.9,
        restitution_deviation: float = 0.03,
        deceleration: float = 0.0,
        sliding: float = 0.0,
        drag: float = 0.0,
        gaps: Sequence[tuple[float, float]] = (),
        gone_height: float = -0.1,
        **settings: Any,
    ) -> None:
        """Roll between cushions at ±``half_extent``, where the target's centre turns back [m].

        Args:
            half_extent: as above, one number for a square table, or one along x and one along y.
            restitution: share of the speed across a cushion that comes back; along it nothing is lost.
            restitution_deviation: standard deviation of that share.
            deceleration: at which a rolling target loses speed [m/s²].
            sliding: at which one does that has bounced, and slides until it rolls again [m/s²]. Whether it slides now
                shows in its history.
            drag: share of its speed that a target on a cushion of air loses in a second [1/s]; in place of both
                decelerations.
            gaps: first and last coordinate, along each of the four cushions, between which there is none [m].
            gone_height: of a target that fell through [m, world].
            settings: those of `AnalyticForecast`.
        """
        super().__init__(**settings)
        if isinstance(half_extent, Sequence):
            half_extent = sides = check_vector("half_extent", half_extent)
        else:
            sides = (half_extent, half_extent)
        if len(sides) != 2:
            raise InputError(f"half_extent must be one number or two, along x and y, got {half_extent!r}")
        for side in sides:
            check_number("half_extent", side, minimum=1e-9)
        check_number("restitution", restitution, minimum=0.01, maximum=1.0)
        check_number("restitution_deviation", restitution_deviation, minimum=0.0)
        check_number("deceleration", deceleration, minimum=0.0)
        check_number("sliding", sliding, minimum=0.0)
        check_number("drag", drag, minimum=0.0)
        if drag and (deceleration or sliding):
            raise InputError(f"a table has drag or decelerations, got {drag:g}, {deceleration:g} and {sliding:g}")
        check_number("gone_height", gone_height)
        for gap in gaps:
            if len(gap) != 2 or not -min(sides) <= gap[0] < gap[1] <= min(sides):
                raise InputError(f"gaps must be pairs that rise within ±{min(sides):g}, got {gap!r}")
        self.half_extent, self.drag = half_extent, drag
        self.restitution, self.restitution_deviation = restitution, restitution_deviation
        self.deceleration, self.sliding, self.gone_height = deceleration, sliding, gone_height
        self.gaps = tuple((float(first), float(last)) for first, last in gaps)

    def follow(self, history: Tensor, velocity: Tensor, time: Tensor, deviation: Tensor) -> Forecast:
        """As of `AnalyticForecast`."""
        level, speed = history[..., -1:, :2], velocity[..., None, :2]
        rolled = self.roll(level, speed, self._slowed(history[..., :2], speed, time))
        wide = deviation.unsqueeze(-1) * rolled.share + self.restitution_deviation * rolled.since * rolled.bounces
        height = history[..., -1:, 2:].expand(*rolled.place.shape[:-1], history.shape[-1] - 2)
        falls = self._falls(rolled, wide, level)
        if falls is None:
            return Forecast(torch.cat([rolled.place, height], dim=-1), normal_spread(wide))
        gone = 1.0 - (1.0 - falls).cumprod(-1)
        # The path is of the likelier of two ends.
        height = torch.where(gone.unsqueeze(-1) > 0.5, self.gone_height, height)
        return Forecast(torch.cat([rolled.place, height], dim=-1), normal_spread(wide, gone))

    def roll(self, place: Tensor, velocity: Tensor, time: Tensor) -> Rolled:
        """Roll from ``place`` with ``velocity`` (*B, 1, 2) for ``time`` (*B, F, 1) [s].

        The path is unfolded: each crossing of the table takes 1/e times as long as the one before, so that the number
        of bounces and what is left after the last one follow from a geometric series.
        """
        half, e = self._half(place), self.restitution
        heading, speed = torch.where(velocity < 0.0, -1.0, 1.0), velocity.abs()
        to_wall = (half - place * heading).clamp_min(0.0)
        covered = speed * time
        # Crossings of the table since the first bounce, had no speed been lost.
        crossings = (covered - to_wall) / (2.0 * half)
        met, after = crossings > 0.0, crossings.clamp_min(0.0)
        if e == 1.0:
            whole = after.detach().floor()
            begun = whole
        else:
            whole = (torch.log1p(after.detach() * (1.0 - e)) / -math.log(e)).floor()
            begun = (e**-whole - 1.0) / (1.0 - e)
        share = e ** (whole + 1.0)
        part = ((after - begun) * share).clamp(0.0, 1.0)
        back = half * (1.0 - 2.0 * part)
        along = torch.where(met, torch.where(whole % 2 == 0, back, -back), place * heading + covered)
        since = torch.where(met, 2.0 * half * (whole + part), 0.0)
        return Rolled(heading * along, (whole + 1.0) * met, torch.where(met, share, 1.0), since)

    def part_settings(self) -> dict[str, Any]:
        """Arguments that make the same model."""
        names = (
            "half_extent",
            "restitution",
            "restitution_deviation",
            "deceleration",
            "sliding",
            "drag",
            "gaps",
            "gone_height",
        )
        return super().part_settings() | {name: getattr(self, name) for name in names}

    def _half(self, like: Tensor) -> Tensor | float:
        """Where a target turns back [m]: a number, or of an oblong table ``(2,)`` of the type of ``like``."""
        return like.new_tensor(self.half_extent) if isinstance(self.half_extent, tuple) else self.half_extent

    def _slowed(self, history: Tensor, velocity: Tensor, time: Tensor) -> Tensor:
        """How long a target of constant ``velocity`` (*B, 1, 2) would take for what it covers: ``(*B, F, 1)`` [s]."""
        moment = time.unsqueeze(-1)
        if self.drag > 0.0:
            return -torch.expm1(-self.drag * moment) / self.drag
        if self.deceleration == self.sliding == 0.0:
            return moment
        speed = velocity.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
        before = self._braking(history)
        place, heading = history[..., -1:, :], torch.where(velocity < 0.0, -1.0, 1.0)
        waits = (self._half(place) - place * heading).clamp_min(0.0) / velocity.abs().clamp_min(1e-9)
        first, axis = waits.min(-1, keepdim=True)
        # Of the speed across the cushion a share is left, and all of the one along it.
        left = velocity * torch.where(torch.arange(2, device=axis.device) == axis, self.restitution, 1.0)
        after = left.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
        free = torch.minimum(moment, first)
        rest = (moment - first).clamp_min(0.0)
        return _covered(free, before / speed) + _covered(rest, self.sliding / after)

    def _braking(self, history: Tensor) -> Tensor:
        """The deceleration now, between that of rolling and of sliding, from positions (*B, H, 2): ``(*B, 1, 1)``."""
        least, most = sorted((self.deceleration, self.sliding))
        if history.shape[-2] <= LOOK_BACK + 2:
            return torch.full_like(history[..., -1:, :1], least)
        moves = (history[..., 2:, :] - history[..., :-2, :]) / (2.0 * self.control_step)
        now, then = (moves[..., -1 - back, :].square().sum(-1) for back in (0, LOOK_BACK))
        # The root's derivative at rest is not a number.
        now, was = (value.clamp_min(1e-12).sqrt() for value in (now, then))
        braking = ((was - now) / (LOOK_BACK * self.control_step)).clamp(least, most)
        # Histories are padded with their first position.
        return torch.where(then > 1e-12, braking, least)[..., None, None]

    def _falls(self, rolled: Rolled, deviation: Tensor, start: Tensor) -> Tensor | None:
        """Probability that the target falls through a gap between one step and the next, ``(*B, F)``."""
        if not self.gaps:
            return None
        met = torch.diff(rolled.bounces, dim=-2, prepend=torch.zeros_like(rolled.bounces[..., :1, :])) > 0.0
        before = torch.cat([start.expand_as(rolled.place[..., :1, :]), rolled.place[..., :-1, :]], dim=-2)
        # Where the other coordinate is in the midst of the step.
        across, wide = (0.5 * (before + rolled.place)).flip(-1), deviation.flip(-1)
        found = torch.zeros_like(across)
        for first, last in self.gaps:
            found = found + torch.special.ndtr((last - across) / wide) - torch.special.ndtr((first - across) / wide)
        return 1.0 - (1.0 - found * met).prod(-1)


def _covered(time: Tensor, braking: Tensor) -> Tensor:
    """What is covered in ``time`` [s] at speed 1, of which ``braking`` [1/s] takes away until nothing is left."""
    moving = torch.minimum(time, 1.0 / braking.clamp_min(1e-9))
    return moving - 0.5 * braking * moving.square()


def normal_spread(deviation: Tensor, gone: Tensor | None = None) -> Spread:
    """The spread nearest to a normal distribution with ``deviation`` (*B, F, 2) along x and y [m]; surely not gone."""
    gone = torch.zeros_like(deviation[..., 0]) if gone is None else gone
    return Spread(MEDIAN * deviation, torch.full_like(deviation, SHAPE), gone)
