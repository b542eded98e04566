"""Forecasts from mechanical models, without training; usable wherever a forecaster is expected."""

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
from torchdyn_plan.kinematics.flight import braked, fly
from torchdyn_plan.nets.distributions import Spread
from torchdyn_plan.nets.forecast import Forecast, ForecastModel
from torchdyn_plan.precision import at_least_float32

MEDIAN = 0.6744897501960817
"""Half of a normal distribution's errors are smaller than this many standard deviations."""
SHAPE = math.log(19.0) / math.log(1.959963984540054 / MEDIAN)
"""With this shape the 50 % and 95 % intervals of a `Spread` are those of a normal distribution."""
LOOK_BACK = 8
"""Control steps over which a target's deceleration is estimated."""
FINEST = 1e-5
"""Lower bound on standard deviations of forecasts [m]."""


class AnalyticForecast(ForecastModel):
    """A forecast by a law of motion from the target's position and velocity.

    The velocity is that of the last step of the history, which a `torchdyn_plan.planners.Track` smooths. The spread
    follows from the uncertainty of both, and from accelerations that the law leaves out.
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
            tracked: read a track's ``target_covariance``; otherwise every position in the history is assumed to have an
                independent error ``noise``.
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
        """The forecast at times ``time`` (F,) from now [s].

        Args:
            history: ``(*B, H, D)``, the present position last [m, world].
            velocity: ``(*B, D)`` over the last step [m/s, world].
            time: ``(F,)`` [s].
            deviation: ``(*B, F)`` standard deviation of the forecast position along each axis [m].
        """

    def predict(self, *seen: Tensor) -> Forecast:
        """Path and spread after histories ``(*B, H, D)`` [m, world], with the history's type."""
        history = seen[0]
        check_points(keys.TARGET_HISTORY, history, history.shape[-2] if history.ndim > 1 else 2)
        history = at_least_float32(history)
        place, velocity = history[..., -1, :], (history[..., -1, :] - history[..., -2, :]) / self.control_step
        time = self.control_step * torch.arange(1, self.horizon + 1, dtype=history.dtype, device=history.device)
        path, spread = self.follow(history, velocity, time, self._deviation(time, seen[1:], place))
        return Forecast(path.to(seen[0].dtype), spread)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this model."""
        names = ("horizon", "control_step", "tracked", "noise", "acceleration")
        return {name: getattr(self, name) for name in names}

    def _deviation(self, time: Tensor, covariance: Sequence[Tensor], place: Tensor) -> Tensor:
        """Standard deviation ``(*B, F)`` at times ``time`` (F,) [s], along each axis [m]."""
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
    """The target flies: it falls with a constant acceleration, and the air slows it down where it has a ``drag``."""

    def __init__(self, *, gravity: Sequence[float] = (0.0, 0.0, -9.81), drag: float = 0.0, **settings: Any) -> None:
        """Fall, and be slowed down.

        Args:
            gravity: D numbers [m/s², world].
            drag: deceleration over speed squared, against the velocity [1/m]; 0 for none.
            settings: those of `AnalyticForecast`.
        """
        super().__init__(**settings)
        self.gravity = check_vector("gravity", gravity)
        check_number("drag", drag, minimum=0.0)
        self.drag = drag

    def follow(self, history: Tensor, velocity: Tensor, time: Tensor, deviation: Tensor) -> Forecast:
        """As of `AnalyticForecast`."""
        path = self.fly_on(history[..., -1, :], velocity, time)
        return Forecast(path, normal_spread(deviation.unsqueeze(-1).expand(*deviation.shape, 2)))

    def fly_on(self, place: Tensor, velocity: Tensor, time: Tensor) -> Tensor:
        """Positions ``(*B, F, D)`` at times ``time`` (F,) from now [s].

        ``place`` (*B, D) is the position now [m, world], ``velocity`` (*B, D) that over the last control step [m/s].
        """
        if len(self.gravity) != place.shape[-1]:
            raise InputError(f"gravity has {len(self.gravity)} numbers, but targets {place.shape[-1]} coordinates")
        falls = time.new_tensor(self.gravity)
        # The mean velocity over the last step is that of half a step ago.
        if self.drag:
            now = velocity + 0.5 * self.control_step * braked(velocity, falls, self.drag)
            law: dict[str, Any] = {"gravity": self.gravity, "drag": self.drag}
            return fly(place, now, step=self.control_step, count=len(time), **law)[0]
        moment, speed = time.unsqueeze(-1), velocity + 0.5 * self.control_step * falls
        return place.unsqueeze(-2) + moment * speed.unsqueeze(-2) + 0.5 * moment.square() * falls

    def continued(self, place: Tensor, step: Tensor) -> Tensor:
        """Positions ``(*B, F, D)`` of targets that made their last ``step`` (*B, D) to ``place`` (*B, D) [m, world]."""
        time = self.control_step * torch.arange(1, self.horizon + 1, dtype=place.dtype, device=place.device)
        return self.fly_on(place, step / self.control_step, time)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this model."""
        # Models that are older than the drag keep their description.
        own: dict[str, Any] = {"gravity": self.gravity} | ({"drag": self.drag} if self.drag else {})
        return super().part_settings() | own


class Rolled(NamedTuple):
    """Motion of a ball along each of two axes between cushions, at F times."""

    place: Tensor
    """``(*B, F, 2)`` [m]."""
    bounces: Tensor
    """``(*B, F, 2)`` number of bounces."""
    share: Tensor
    """``(*B, F, 2)`` remaining share of its speed."""
    since: Tensor
    """``(*B, F, 2)`` distance covered since its first bounce [m]."""


class Billiard(AnalyticForecast):
    """The target rolls on a level table between four cushions, which mirror its path and reduce its speed.

    At a gap in a cushion the target falls through: its path continues at ``gone_height``, and the spread holds the
    probability of that.
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
            half_extent: as above, one number for a square table, or two, along x and y.
            restitution: restitution coefficient normal to a cushion; tangential speed is kept.
            restitution_deviation: its standard deviation.
            deceleration: of a rolling target [m/s²].
            sliding: deceleration of a target that slides after a bounce, until it rolls again [m/s²]. Whether it slides
                now is estimated from its history.
            drag: share of its speed that a target on an air cushion loses per second [1/s]; it replaces both
                decelerations.
            gaps: first and last coordinate of each gap along each of the four cushions [m].
            gone_height: height of a target that fell through [m, world].
            settings: settings of `AnalyticForecast`.
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
        # The path takes the likelier of the two outcomes.
        height = torch.where(gone.unsqueeze(-1) > 0.5, self.gone_height, height)
        return Forecast(torch.cat([rolled.place, height], dim=-1), normal_spread(wide, gone))

    def roll(self, place: Tensor, velocity: Tensor, time: Tensor) -> Rolled:
        """Roll from ``place`` with ``velocity`` (*B, 1, 2) for ``time`` (*B, F, 1) [s].

        The path is unreflected: each crossing of the table takes 1/e times as long as the last, so that the number of
        bounces and the remainder after the last one follow from a geometric series.
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
        """Constructor arguments of this model."""
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
        """Time in which a target at constant ``velocity`` (*B, 1, 2) covers the same distance: ``(*B, F, 1)`` [s]."""
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
        # Part of the normal speed is left, and all of the tangential speed.
        left = velocity * torch.where(torch.arange(2, device=axis.device) == axis, self.restitution, 1.0)
        after = left.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
        free = torch.minimum(moment, first)
        rest = (moment - first).clamp_min(0.0)
        return _covered(free, before / speed) + _covered(rest, self.sliding / after)

    def _braking(self, history: Tensor) -> Tensor:
        """Present deceleration, between rolling and sliding, from positions (*B, H, 2): ``(*B, 1, 1)``."""
        least, most = sorted((self.deceleration, self.sliding))
        if history.shape[-2] <= LOOK_BACK + 2:
            return torch.full_like(history[..., -1:, :1], least)
        moves = (history[..., 2:, :] - history[..., :-2, :]) / (2.0 * self.control_step)
        now, then = (moves[..., -1 - back, :].square().sum(-1) for back in (0, LOOK_BACK))
        # The root's derivative at rest is infinite.
        now, was = (value.clamp_min(1e-12).sqrt() for value in (now, then))
        braking = ((was - now) / (LOOK_BACK * self.control_step)).clamp(least, most)
        # Histories are padded with their first position.
        return torch.where(then > 1e-12, braking, least)[..., None, None]

    def _falls(self, rolled: Rolled, deviation: Tensor, start: Tensor) -> Tensor | None:
        """Probability that the target falls through a gap in each step, ``(*B, F)``."""
        if not self.gaps:
            return None
        met = torch.diff(rolled.bounces, dim=-2, prepend=torch.zeros_like(rolled.bounces[..., :1, :])) > 0.0
        before = torch.cat([start.expand_as(rolled.place[..., :1, :]), rolled.place[..., :-1, :]], dim=-2)
        # The other coordinate in the middle of the step.
        across, wide = (0.5 * (before + rolled.place)).flip(-1), deviation.flip(-1)
        found = torch.zeros_like(across)
        for first, last in self.gaps:
            found = found + torch.special.ndtr((last - across) / wide) - torch.special.ndtr((first - across) / wide)
        return 1.0 - (1.0 - found * met).prod(-1)


def _covered(time: Tensor, braking: Tensor) -> Tensor:
    """Distance covered in ``time`` [s] from speed 1, with deceleration ``braking`` [1/s] until rest."""
    moving = torch.minimum(time, 1.0 / braking.clamp_min(1e-9))
    return moving - 0.5 * braking * moving.square()


def normal_spread(deviation: Tensor, gone: Tensor | None = None) -> Spread:
    """The spread nearest to a normal distribution with ``deviation`` (*B, F, 2) [m]; ``gone`` is 0 for None."""
    gone = torch.zeros_like(deviation[..., 0]) if gone is None else gone
    return Spread(MEDIAN * deviation, torch.full_like(deviation, SHAPE), gone)
