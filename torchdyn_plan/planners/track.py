"""Tracking filters: they turn measurements of any rate and quality into an estimate of the target's motion.

Time is in seconds since the reset, on the clock of the measurements. A `Track` holds settings only; its memory is a
`TrackState` of tensors, which the caller stores from step to step.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import debug_unwrap

from torchdyn_plan.checks import (
    POINT_SIZES,
    check_number,
    check_trailing_shape,
    check_vector,
    hides_values,
    is_followed,
)
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.rows import where_rows
from torchdyn_plan.planners.track_row import numbers_of, row_of, updated_row

LARGEST = 1e6
"""Measurements farther from the origin [m], or with a larger time stamp [s], are rejected."""
ONE = torch.ones(())
"""Adding it to a tensor, times a number as ``alpha``, takes half as long as adding the number."""
CLOCKS = 1e-4
"""A time stamp may lie this far in the future, because clocks round [s]."""


class TrackState(NamedTuple):
    """Estimate of each target's motion: position, velocity and, for n = 3, acceleration along D axes."""

    motion: Tensor
    """``(*B, Dn + n(n+1)/2)`` at ``time``: position, velocity … [m, m/s, m/s²; world], then the upper triangle, row by
    row, of the covariance along one axis; it is the same for every axis."""
    time: Tensor
    """``(*B,)`` time of the newest measurement used, -inf for none [s]."""
    begin: Tensor
    """``(*B,)`` time of the first measurement [s]."""
    since: Tensor
    """``(*B,)`` start of the current motion: the first measurement, or the first one after a bounce [s]."""
    before: Tensor
    """``(*B, 2D)`` position and velocity at ``since``, extrapolated from the motion before the bounce [m, m/s]."""
    used: Tensor
    """``(*B,)`` int64 number of measurements used."""
    restarts: Tensor
    """``(*B,)`` int64 number of measurements that did not fit and restarted the motion: mostly bounces."""
    rejected: Tensor
    """``(*B,)`` int64 number of measurements rejected: NaN, from the future, too old, or too far away."""

    @property
    def pos(self) -> Tensor:
        """``(*B, D)`` at ``time`` [m, world]."""
        return self.motion[..., : _sizes(self.motion)[0]]

    @property
    def velocity(self) -> Tensor:
        """``(*B, D)`` at ``time`` [m/s, world]."""
        coordinates, _ = _sizes(self.motion)
        return self.motion[..., coordinates : 2 * coordinates]

    @property
    def covariance(self) -> Tensor:
        """``(*B, 2, 2)`` of position and velocity along each axis [m², m²/s; m²/s, m²/s²]."""
        coordinates, n = _sizes(self.motion)
        own = self.motion[..., coordinates * n :]
        return torch.stack([own[..., :2], torch.stack([own[..., 1], own[..., n]], dim=-1)], dim=-2)

    def path(self, time: Tensor) -> Tensor:
        """Positions ``(*B, T, D)`` [m, world] at times ``time`` (*B, T) [s].

        Times before the last bounce use the motion before it. Before the first measurement the target is taken to rest
        at its first position.
        """
        time = torch.maximum(time, self.begin.unsqueeze(-1))
        since, (coordinates, n) = self.since.unsqueeze(-1), _sizes(self.motion)
        # Rows without a measurement have time -inf.
        passed = time - self.time.clamp_min(-LARGEST).unsqueeze(-1)
        now = _polynomial(self.motion[..., : coordinates * n], passed, coordinates)
        earlier = time < since
        if not (hides_values(earlier) or debug_unwrap(earlier).any()):
            return now
        return torch.where(earlier.unsqueeze(-1), _polynomial(self.before, time - since, coordinates), now)


class Measurement(NamedTuple):
    """One measurement in each row."""

    time: Tensor
    """``(*B,)`` time stamp, NaN for no measurement [s]."""
    pos: Tensor
    """``(*B, D)`` [m, world]."""
    variance: Tensor | float
    """``(*B,)`` variance of its error along each axis [m²]."""


class Prediction(NamedTuple):
    """The filter's prediction of a measurement in each row. Components come first: ``(D, *B)``, or ``(1, *B)``."""

    mean: list[Tensor]
    """n of ``(D, *B)``: the motion at the time of the newest measurement, this one included."""
    covariance: list[list[Tensor]]
    """The rows of its upper triangle, ``(1, *B)`` each."""
    passed: Tensor
    """``(*B,)`` time since the newest earlier measurement [s]; negative if this one is out of order."""
    lever: list[Tensor]
    """n of ``(1, *B)``: covariance of the motion with the measured position."""
    innovation: Tensor
    """``(D, *B)`` measured minus predicted position [m]."""
    variance: Tensor
    """``(1, *B)`` of the innovation along each axis [m²]."""


@dataclass(frozen=True, kw_only=True)
class Track(ABC):
    """Follows one target in each row with a linear filter.

    A measurement outside the gate restarts the motion: the target has bounced, and part of its speed is reversed.
    A measurement is rejected if it is NaN, from the future, too old, or farther away than the target can have moved.
    A late or out-of-order measurement updates the present state, with variance added for the time since it was taken.
    Several measurements may have the same time stamp.
    """

    noise: float = 0.001
    """Standard deviation of a measurement's error along each axis, unless the measurement comes with its own [m]."""
    speed: float = 3.0
    """Prior standard deviation of the velocity along each axis [m/s]."""
    max_speed: float = 20.0
    """Largest speed of a target [m/s]."""
    gate: float = 5.0
    """A measurement fits if it is within this many standard deviations of its prediction."""
    rebound: float = 0.9
    """Share of the speed assumed to be reversed by a bounce, along the axes in which the measurement does not fit."""
    patience: float = 0.2
    """A track stays usable this long without a measurement [s]."""
    least: int = 2
    """Number of measurements that make a track usable."""
    oldest: float = 0.5
    """A measurement older than the newest one by more than this is rejected [s]."""

    def __post_init__(self) -> None:
        check_number("noise", self.noise, minimum=1e-6)
        for name in ("speed", "max_speed", "gate", "patience", "oldest"):
            check_number(name, getattr(self, name), minimum=1e-6)
        check_number("rebound", self.rebound, minimum=0.0, maximum=1.0)
        check_number("least", self.least, minimum=1, integer=True)

    def told(self) -> dict[str, Any]:
        """Its kind and settings by name, to be stored in files."""
        # As JSON has it: what is read from a file is compared with it.
        own = (
            (name, list(value) if isinstance(value, tuple) else value)
            for name, value in dataclasses.asdict(self).items()
        )
        return {"kind": type(self).__name__} | dict(own)

    @property
    def order(self) -> int:
        """n: 2 for position and velocity, 3 with acceleration."""
        return 2

    @property
    def forgets(self) -> float:
        """Rate at which past measurements are forgotten [1/s]."""
        return 0.0

    @property
    @abstractmethod
    def wander(self) -> float:
        """Spectral density of the process noise, which acts on the last of the n derivatives."""

    @cached_property
    def _drift(self) -> tuple[tuple[int, int, int, float], ...]:
        """Process noise: entries (i, j, power, factor), each adding factor t^power to the covariance in t seconds."""
        n, found = self.order, []
        # White noise of spectral density q on the last derivative (Bar-Shalom et al., Estimation, 6.2):
        # Q_ij = q t^(2n-1-i-j) / ((n-1-i)! (n-1-j)! (2n-1-i-j)).
        for i in range(n if self.wander else 0):
            for j in range(i, n):
                power, below = 2 * n - 1 - i - j, math.factorial(n - 1 - i) * math.factorial(n - 1 - j)
                found.append((i, j, power, self.wander / (below * power)))
        return tuple(found)

    def start(self, like: Tensor) -> TrackState:
        """The state before any measurement, with the batch, type and device of ``like`` (*B, D)."""
        *batch, coordinates = like.shape
        n = self.order
        none = torch.zeros(batch, dtype=torch.int64, device=like.device)
        zero = like.new_zeros(batch)
        motion = like.new_zeros(*batch, coordinates * n + n * (n + 1) // 2)
        return TrackState(
            motion, zero - torch.inf, zero, zero, like.new_zeros(*batch, 2 * coordinates), none, none, none
        )

    def add(
        self, state: TrackState, time: Tensor, pos: Tensor, now: Tensor, *, variance: Tensor | float | None = None
    ) -> TrackState:
        """The state after one measurement in each row; rows with time NaN have none. Differentiable.

        Args:
            state: the state before it.
            time: ``(*B,)`` time stamp [s].
            pos: ``(*B, D)`` [m, world].
            now: ``(*B,)`` current time [s].
            variance: ``(*B,)`` variance of its error along each axis [m²]; the square of ``noise`` for None.

        Raises:
            InputError: a shape is wrong.
        """
        coordinates, _ = _sizes(state.motion)
        if pos.shape != (*time.shape, coordinates) or time.shape != state.time.shape:
            check_trailing_shape("time of a measurement", time, *state.time.shape)
            check_trailing_shape("pos of a measurement", pos, *state.time.shape, coordinates)
        measured = Measurement(time, pos, self.noise**2 if variance is None else variance)
        if _is_row(state, measured) and (found := self._row(state, measured, now)) is not None:
            return found
        looks = not hides_values(time)
        # A camera is slower than the control loop: most steps bring no measurement.
        if looks and bool(debug_unwrap(time).isnan().all()):
            return state
        if looks and _is_in_order(debug_unwrap(state.time), debug_unwrap(time), debug_unwrap(now)):
            expected = self._expect_next(state, measured)
            # The least of what is no number is no number, which is not above zero.
            if debug_unwrap(self._slack(expected)).min().item() >= 0.0:
                return self._used(state, expected, time)
            return self._sorted(state, measured, now, self._fit(expected).all(0))
        expected = self._expect(state, measured)
        # Comparisons with NaN, and in rows without a measurement, are false.
        fits = (self._fit(expected).all(0) & (expected.passed >= -self.oldest)) & (time <= now + CLOCKS)
        if not hides_values(fits) and debug_unwrap(fits).all():
            return self._used(state, expected, torch.maximum(state.time, time))
        return self._sorted(state, measured, now, fits)

    def at(self, state: TrackState, now: Tensor) -> TrackState:
        """The state predicted to ``now`` (*B,) [s], without a measurement."""
        now = torch.maximum(now, state.time)
        passed = torch.where(state.used > 0, now - state.time, 0.0)
        return state._replace(motion=_packed(*self._ahead(state, passed)), time=now)

    def usable(self, state: TrackState, now: Tensor) -> Tensor:
        """``(*B,)`` bool: whether the track can be used at time ``now`` (*B,) [s]."""
        return (state.used >= self.least) & (now - state.time <= self.patience)

    def _row(self, state: TrackState, measured: Measurement, now: Tensor) -> TrackState | None:
        """`add` for one target whose measurement is missing, or comes in order, soon, and fits; None for any other."""
        _, last, begin, since, before, used, restarts, rejected = state
        time, pos, variance = measured
        moment, earlier = time.item(), last.item()
        if math.isnan(moment):
            return state
        passed = moment - earlier
        if not (0.0 <= passed <= self.patience and moment <= now.item() + CLOCKS):
            return None
        variance = variance.item() if isinstance(variance, Tensor) else variance
        numbers = numbers_of(state.motion), numbers_of(pos), passed, variance
        found = updated_row(*numbers, drift=self._drift, forgets=self.forgets, gate=self.gate)
        if found is None:
            return None
        motion = row_of(found, state.motion)
        return TrackState(motion, time, begin, since, before, used + 1, restarts, rejected)

    def _expect_next(self, state: TrackState, measured: Measurement) -> Prediction:
        """`_expect` for the common case that no row's measurement is late: fewer operations, the same result."""
        time, pos, error = measured
        passed = time - state.time
        mean, covariance = self._ahead(state, passed)
        own = covariance[0][0]
        variance = own + error if isinstance(error, Tensor) else torch.add(own, ONE, alpha=error)
        return Prediction(mean, covariance, passed, covariance[0], pos.movedim(-1, 0) - mean[0], variance)

    def _ahead(self, state: TrackState, passed: Tensor) -> tuple[list[Tensor], list[list[Tensor]]]:
        """Mean and covariance ``passed`` (*B,) seconds after the state; ``passed`` is not negative."""
        mean, covariance = _unpacked(state.motion)
        if self.order == 2:
            place, velocity = mean
            return [torch.addcmul(place, passed, velocity), velocity], self._spread(covariance, passed)
        forward = _factors(passed, self.order)
        return [_sum(mean[i:], forward) for i in range(self.order)], self._spread(covariance, passed)

    def _expect(self, state: TrackState, measured: Measurement) -> Prediction:
        """The prediction of a measurement, which may be late."""
        mean, covariance = _unpacked(state.motion)
        passed = measured.time - state.time
        ahead = passed.clamp_min(0.0)
        covariance = self._spread(covariance, ahead)
        behind = passed - ahead
        late = _factors(behind, self.order)
        lever = [_sum(row, late) for row in _whole(covariance)]
        innovation = measured.pos.movedim(-1, 0) - _sum(mean, _factors(passed, self.order))
        scale = _sum(lever, late) + measured.variance
        if self._drift:
            # Process noise since a late measurement was taken adds to its variance.
            _, _, power, factor = self._drift[0]
            scale = torch.add(scale, _power(-behind, power), alpha=factor)
        forward = _factors(ahead, self.order)
        mean = [_sum(mean[i:], forward) for i in range(self.order)]
        return Prediction(mean, covariance, passed, lever, innovation, scale)

    def _spread(self, covariance: list[list[Tensor]], ahead: Tensor) -> list[list[Tensor]]:
        """The covariance ``ahead`` (*B,) seconds later: F P Fᵀ + Q, with F of a chain of n integrators."""
        if self.order == 2 and not self.forgets:
            return self._spread_pair(covariance, ahead)
        n, forward = self.order, _factors(ahead, self.order)
        whole = _whole(covariance)
        half = [[_sum([whole[k][j] for k in range(i, n)], forward) for j in range(i, n)] for i in range(n)]
        found = [[_sum(half[i][j - i :], forward) for j in range(i, n)] for i in range(n)]
        if self.forgets:
            weaker = torch.exp(self.forgets * ahead)
            found = [[entry * weaker for entry in row] for row in found]
        if self._drift:
            powers = [ahead]
            while len(powers) < n:
                powers.append(powers[-1] * ahead)
            for i, j, power, factor in self._drift:
                found[i][j - i] = _with_power(found[i][j - i], powers, power, factor)
        return found

    def _spread_pair(self, covariance: list[list[Tensor]], ahead: Tensor) -> list[list[Tensor]]:
        """`_spread` of position and velocity, of which nothing is forgotten: polynomials in t by Horner's rule."""
        (place, both), (speed,) = covariance
        q = self.wander
        # P00 + 2 P01 t + P11 t² + q t³/3, P01 + P11 t + q t²/2 and P11 + q t.
        third = half = speed
        if q:
            third, half = torch.add(speed, ahead, alpha=q / 3.0), torch.add(speed, ahead, alpha=q / 2.0)
            speed = torch.add(speed, ahead, alpha=q)
        place = torch.addcmul(place, ahead, torch.addcmul(both, ahead, third, value=0.5), value=2.0)
        return [[place, torch.addcmul(both, ahead, half)], [speed]]

    def _slack(self, expected: Prediction) -> Tensor:
        """By how much a measurement is where it was expected, along each axis ``(D, *B)``; negative if it is not."""
        return torch.addcmul(expected.variance, expected.innovation, expected.innovation, value=-1.0 / self.gate**2)

    def _fit(self, expected: Prediction) -> Tensor:
        """``(D, *B)`` bool: whether the measurement is within the gate, along each axis."""
        return self._slack(expected) >= 0.0

    def _used(self, state: TrackState, expected: Prediction, newest: Tensor) -> TrackState:
        """The Kalman filter's update, for measurements that fit in all rows; the state is at ``newest`` (*B,) [s]."""
        mean, covariance, _, lever, innovation, variance = expected
        gain = [entry / variance for entry in lever]
        if self.order == 2:
            # Most measurements come this way: loops would take as long as two operations.
            (place, velocity), ((own, both), (rate,)), (first, second), (a, b) = mean, covariance, lever, gain
            place, velocity = torch.addcmul(place, a, innovation), torch.addcmul(velocity, b, innovation)
            own, both = torch.addcmul(own, a, first, value=-1.0), torch.addcmul(both, a, second, value=-1.0)
            parts = [place, velocity, own, both, torch.addcmul(rate, b, second, value=-1.0)]
        else:
            parts = [torch.addcmul(entry, factor, innovation) for entry, factor in zip(mean, gain, strict=True)]
            for i, row in enumerate(covariance):
                parts += [torch.addcmul(entry, gain[i], lever[i + k], value=-1.0) for k, entry in enumerate(row)]
        _, _, begin, since, before, used, restarts, rejected = state
        motion = torch.cat(parts).movedim(0, -1)
        return TrackState(motion, newest, begin, since, before, used + 1, restarts, rejected)

    def _sorted(self, state: TrackState, measured: Measurement, now: Tensor, fits: Tensor) -> TrackState:
        """`add` where rows differ: in some the motion restarts, in others the measurement is missing or rejected."""
        time, pos, _ = measured
        given, known = ~time.isnan(), state.used > 0
        usable = (pos.abs().amax(-1) <= LARGEST) & (time <= now + CLOCKS) & (time.abs() <= LARGEST)
        usable = usable & ~(time < state.time - self.oldest)
        # NaN must not enter the computation of unused rows either: it would reach the gradients.
        last = torch.where(known, state.time, 0.0)
        measured = measured._replace(time=torch.where(usable, time, last), pos=where_rows(usable, pos, state.pos))
        state = state._replace(time=last)
        expected, passed = self._expect(state, measured), measured.time - last
        lost = ~known | (passed > self.patience)
        reach = self.max_speed * passed + self.gate * expected.variance[0].sqrt()
        flies = expected.innovation.abs().amax(0) > reach
        begins = usable & ~fits & (lost | (~flies & (passed >= 0.0)))
        newest = torch.maximum(last, measured.time)
        begun, used = self._begun(state, expected, measured, lost), self._used(state, expected, newest)
        kept = (where_rows(fits, new, old) for new, old in zip(used, state, strict=True))
        found = TrackState(*(where_rows(begins, new, old) for new, old in zip(begun, kept, strict=True)))
        return found._replace(
            time=torch.where(found.used > 0, found.time, -torch.inf),
            rejected=state.rejected + (given & ~fits & ~begins),
        )

    def _begun(self, state: TrackState, expected: Prediction, measured: Measurement, lost: Tensor) -> TrackState:
        """The state where a measurement starts a motion: after a bounce or, in rows ``lost`` (*B,), from the prior.

        A bounce reverses the velocity along the axes in which the measurement does not fit.
        """
        time, pos, variance = measured
        where, velocity = pos.movedim(-1, 0), expected.mean[1]
        turned = velocity * torch.where(self._fit(expected), 1.0, -self.rebound)
        turned = torch.where(lost, 0.0, turned)
        before = [torch.where(lost, new, old) for new, old in zip([where, turned], expected.mean, strict=False)]
        return TrackState(
            motion=_packed([where, turned, *self._expected(where)], self._unsure(time, variance)),
            time=time,
            begin=torch.where(lost, time, state.begin),
            since=time,
            before=torch.cat(before).movedim(0, -1),
            used=torch.where(lost, 0, state.used) + 1,
            restarts=state.restarts + (state.used > 0),
            rejected=state.rejected,
        )

    def _unsure(self, like: Tensor, variance: Tensor | float) -> list[list[Tensor]]:
        """Prior covariance with a position of ``variance`` (*B,) known; batch and type of ``like`` (*B,)."""
        zero = torch.zeros_like(like).unsqueeze(0)
        spreads = [zero + variance, *(zero + deviation**2 for deviation in self._unknown)]
        return [[spreads[i], *[zero] * (self.order - 1 - i)] for i in range(self.order)]

    @property
    def _unknown(self) -> list[float]:
        """Prior standard deviations of the velocity and further derivatives."""
        return [self.speed]

    def _expected(self, like: Tensor) -> list[Tensor]:
        """Further derivatives, ``(D, *B)`` each as ``like``, that are expected of a target whose motion begins."""
        return [torch.zeros_like(like)] * (self.order - 2)


@dataclass(frozen=True, kw_only=True)
class KalmanTrack(Track):
    """Kalman filter with a constant-velocity or constant-acceleration model and white process noise."""

    agility: float = 0.1
    """Square root of the spectral density of the process noise: in t seconds the last derivative drifts by
    ``agility``·√t [m/s² per √Hz; with ``accelerates`` m/s³]."""
    accelerates: bool = False
    """Whether the model is constant acceleration rather than constant velocity."""
    acceleration: float = 1.0
    """Prior standard deviation of the acceleration, with ``accelerates`` [m/s²]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("agility", self.agility, minimum=0.0)
        check_number("acceleration", self.acceleration, minimum=1e-6)

    @property
    def order(self) -> int:
        """As of `Track`."""
        return 3 if self.accelerates else 2

    @property
    def wander(self) -> float:
        """As of `Track`."""
        return self.agility**2

    @property
    def _unknown(self) -> list[float]:
        return [self.speed, self.acceleration] if self.accelerates else [self.speed]


@dataclass(frozen=True, kw_only=True)
class BallisticTrack(Track):
    """The Kalman filter of a target that falls with gravity, but for what else accelerates it, as drag does."""

    gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
    """Acceleration that is expected, a number for each axis [m/s², world]."""
    acceleration: float = 0.5
    """Standard deviation of what else accelerates the target, along each axis [m/s²]."""
    agility: float = 1.0
    """After t seconds without a measurement the acceleration may have changed by ``agility``·√t [m/s³ per √Hz]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "gravity", check_vector("gravity", self.gravity))
        check_number("acceleration", self.acceleration, minimum=1e-6)
        check_number("agility", self.agility, minimum=0.0)

    @property
    def order(self) -> int:
        """As of `Track`."""
        return 3

    @property
    def wander(self) -> float:
        """As of `Track`."""
        return self.agility**2

    @property
    def _unknown(self) -> list[float]:
        return [self.speed, self.acceleration]

    def _expected(self, like: Tensor) -> list[Tensor]:
        if len(self.gravity) != len(like):
            raise InputError(f"gravity has {len(self.gravity)} numbers, but targets {len(like)} coordinates")
        falls = like.new_tensor(self.gravity).view(-1, *[1] * (like.ndim - 1))
        return [falls.expand_as(like)]


@dataclass(frozen=True, kw_only=True)
class LeastSquaresTrack(Track):
    """A straight line fitted to the measurements by least squares, weighted by e^(-age/window)."""

    window: float = 0.1
    """Time in which a measurement's weight falls to 1/e [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("window", self.window, minimum=1e-6)

    @property
    def forgets(self) -> float:
        """As of `Track`."""
        return 1.0 / self.window

    @property
    def wander(self) -> float:
        """As of `Track`."""
        return 0.0


def _is_in_order(before: Tensor, time: Tensor, now: Tensor) -> bool:
    """Whether every row has a measurement, none older than the row's newest (``before`` (*B,)) or from the future."""
    return bool(((time >= before) & (time <= now + CLOCKS)).all())


def _is_row(state: TrackState, measured: Measurement) -> bool:
    """Whether there is one target, on the CPU and without derivatives, so that numbers do for tensors."""
    (time, pos, variance), motion = measured, state.motion
    if time.numel() != 1 or not motion.is_cpu or motion.dtype != pos.dtype or torch.compiler.is_compiling():
        return False
    return not is_followed(motion, state.time, time, pos, variance if isinstance(variance, Tensor) else time)


SIZES = {d * n + n * (n + 1) // 2: (d, n) for d in POINT_SIZES for n in (2, 3)}
"""Coordinates D and order n by the numbers of a motion, Dn + n(n+1)/2: no two have as many."""
PARTS = {size: [d] * n + [1] * (n * (n + 1) // 2) for size, (d, n) in SIZES.items()}
"""Sizes of a motion's parts: its mean, and the entries of its covariance."""
ROWS = {2: (slice(2, 4), slice(4, 5)), 3: (slice(3, 6), slice(6, 8), slice(8, 9))}
"""Which of the parts are the rows of the covariance's upper triangle, by order n."""


def _sizes(motion: Tensor) -> tuple[int, int]:
    """Coordinates D and order n of ``motion`` (*B, Dn + n(n+1)/2)."""
    return SIZES[motion.shape[-1]]


def _unpacked(motion: Tensor) -> tuple[list[Tensor], list[list[Tensor]]]:
    """Mean, n of ``(D, *B)``, and the rows of the covariance's upper triangle, ``(1, *B)`` each."""
    size = motion.shape[-1]
    _, n = SIZES[size]
    parts = list(motion.movedim(-1, 0).split_with_sizes(PARTS[size]))
    return parts[:n], [parts[row] for row in ROWS[n]]


def _packed(mean: list[Tensor], covariance: list[list[Tensor]]) -> Tensor:
    """The motion ``(*B, Dn + n(n+1)/2)``; components come first in memory, which makes them cheap to take apart."""
    return torch.cat([*mean, *(entry for row in covariance for entry in row)]).movedim(0, -1)


def _whole(triangle: list[list[Tensor]]) -> list[list[Tensor]]:
    """The rows of a symmetric matrix, from its upper triangle."""
    n = len(triangle)
    return [[triangle[min(i, j)][abs(i - j)] for j in range(n)] for i in range(n)]


def _factors(time: Tensor, n: int) -> list[Tensor]:
    """t, t²/2 … of ``time``, n - 1 terms of the Taylor series."""
    found = [time]
    while len(found) < n - 1:
        found.append(found[-1] * time / (len(found) + 1))
    return found


def _sum(terms: Sequence[Tensor], factors: list[Tensor]) -> Tensor:
    """The first of ``terms``, and each further one times its factor."""
    found = terms[0]
    for term, factor in zip(terms[1:], factors, strict=False):
        found = torch.addcmul(found, term, factor)
    return found


def _power(value: Tensor, exponent: int) -> Tensor:
    """``value`` to an integer power by multiplication: cheaper than ``pow``, and its derivative at 0 is finite."""
    found = value
    for _ in range(exponent - 1):
        found = found * value
    return found


def _with_power(value: Tensor, powers: list[Tensor], power: int, factor: float) -> Tensor:
    """``value`` + ``factor`` t^``power``; t^``power`` is the product of two of the ``powers`` (t, t² …)."""
    if power == 1:
        return torch.add(value, powers[0], alpha=factor)
    half = power // 2
    return torch.addcmul(value, powers[half - 1], powers[power - half - 1], value=factor)


def _polynomial(motion: Tensor, passed: Tensor, coordinates: int) -> Tensor:
    """Positions ``(*B, T, D)`` after ``passed`` (*B, T) [s] from position, velocity … ``(*B, Dn)``."""
    terms = motion.unsqueeze(-2).split(coordinates, dim=-1)
    return _sum(terms, _factors(passed.unsqueeze(-1), len(terms)))
