"""What lies between a camera and a planner: measurements at any time, of any quality, become a motion that is known.

Time is in seconds since the reset, on the clock of the measurements. A track is a plain set of numbers, and all that it
remembers is a `TrackState` of tensors, which whoever uses it stores from step to step.
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

from torchdyn_plan.checks import POINT_SIZES, check_number, check_trailing_shape, hides_values
from torchdyn_plan.planners.rows import where_rows

LARGEST = 1e6
"""No place that is measured is farther from the origin [m], and no moment from the reset [s]."""
ONE = torch.ones(())
"""Times a number's ``alpha``, it is added to a tensor at half the price of the number itself."""
CLOCKS = 1e-4
"""A measurement may come this much from the future: clocks round [s]."""


class TrackState(NamedTuple):
    """What is known of each target: position, velocity and, for n = 3, acceleration, alike along all D axes."""

    motion: Tensor
    """``(*B, Dn + n(n+1)/2)`` at ``time``: position, velocity … [m, m/s, m/s²; world], then the covariance of each axis
    alone, the same for all, the upper triangle row by row."""
    time: Tensor
    """``(*B,)`` moment of the newest measurement that was used, -inf for none [s]."""
    begin: Tensor
    """``(*B,)`` moment of the first measurement [s]."""
    since: Tensor
    """``(*B,)`` moment from which on the target moves as it does: the first measurement, or that after a bounce [s]."""
    before: Tensor
    """``(*B, 2D)`` position and velocity at ``since`` by the motion before the bounce [m, m/s]."""
    used: Tensor
    """``(*B,)`` int64 measurements that were used."""
    restarts: Tensor
    """``(*B,)`` int64 of these that did not fit the motion before, and began another: bounces, mostly."""
    rejected: Tensor
    """``(*B,)`` int64 measurements that were of no use: no numbers, from the future, too old, or too far away."""

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
        """Positions ``(*B, T, D)`` at moments ``time`` (*B, T) [s]: before a bounce by the motion of then [m, world].

        Before the first measurement the target rests where the motion begins.
        """
        time = torch.maximum(time, self.begin.unsqueeze(-1))
        since, (coordinates, n) = self.since.unsqueeze(-1), _sizes(self.motion)
        # Of rows of which nothing is known the time is infinite.
        passed = time - self.time.clamp_min(-LARGEST).unsqueeze(-1)
        now = _polynomial(self.motion[..., : coordinates * n], passed, coordinates)
        earlier = time < since
        if not (hides_values(earlier) or debug_unwrap(earlier).any()):
            return now
        return torch.where(earlier.unsqueeze(-1), _polynomial(self.before, time - since, coordinates), now)


class Measurement(NamedTuple):
    """A measurement in each row."""

    time: Tensor
    """``(*B,)`` when it was taken; NaN for none [s]."""
    pos: Tensor
    """``(*B, D)`` [m, world]."""
    variance: Tensor | float
    """``(*B,)`` of its error along each axis [m²]."""


class Prediction(NamedTuple):
    """What is expected of a measurement in each row. Components come first: ``(D, *B)``, and ``(1, *B)`` for one."""

    mean: list[Tensor]
    """n of ``(D, *B)``: the motion at the moment of the newest measurement, this one included."""
    covariance: list[list[Tensor]]
    """The rows of its upper triangle, ``(1, *B)`` each."""
    passed: Tensor
    """``(*B,)`` since the newest measurement before this one [s]; negative if this one is late."""
    lever: list[Tensor]
    """n of ``(1, *B)``: covariance of the motion with the position that was measured."""
    innovation: Tensor
    """``(D, *B)`` what was measured less what was expected [m]."""
    variance: Tensor
    """``(1, *B)`` of the innovation along each axis [m²]."""


@dataclass(frozen=True, kw_only=True)
class Track(ABC):
    """Follows one target in each row by a linear filter.

    A measurement that does not fit begins the motion anew: the target has bounced, and some of its speed comes back.
    One that is no number, is from the future, too old or so far off that the target would have had to fly there is not
    used. One that is late or out of order is used for what it says of the present, less sure for what may have happened
    since; several may be of one moment.
    """

    noise: float = 0.001
    """Standard deviation of a measurement's error along each axis, where a measurement does not bring its own [m]."""
    speed: float = 3.0
    """Standard deviation of the speed along each axis of a target of which nothing is known [m/s]."""
    max_speed: float = 20.0
    """No target moves faster [m/s]."""
    gate: float = 5.0
    """A measurement fits up to so many standard deviations of what is expected of it."""
    rebound: float = 0.9
    """Share of the speed that is taken to come back from a bounce, along the axes in which it shows."""
    patience: float = 0.2
    """So long a track is of use without a measurement [s]."""
    least: int = 2
    """Measurements from which on a track is of use."""
    oldest: float = 0.5
    """A measurement older than the newest one by more than this is not used [s]."""

    def __post_init__(self) -> None:
        check_number("noise", self.noise, minimum=1e-6)
        for name in ("speed", "max_speed", "gate", "patience", "oldest"):
            check_number(name, getattr(self, name), minimum=1e-6)
        check_number("rebound", self.rebound, minimum=0.0, maximum=1.0)
        check_number("least", self.least, minimum=1, integer=True)

    def told(self) -> dict[str, Any]:
        """Its kind, and every number by name, for files."""
        return {"kind": type(self).__name__} | dataclasses.asdict(self)

    @property
    def order(self) -> int:
        """n: 2 for position and velocity, 3 with acceleration."""
        return 2

    @property
    def forgets(self) -> float:
        """Rate at which the past counts less, whatever is measured [1/s]."""
        return 0.0

    @property
    @abstractmethod
    def wander(self) -> float:
        """Spectral density of what changes the last of the n derivatives."""

    @cached_property
    def _drift(self) -> tuple[tuple[int, int, int, float], ...]:
        """What noise adds to entry (i, j) of the covariance in t seconds: power of t, and factor."""
        n, found = self.order, []
        # White noise of spectral density q on the last derivative (Bar-Shalom et al., Estimation, 6.2):
        # Q_ij = q t^(2n-1-i-j) / ((n-1-i)! (n-1-j)! (2n-1-i-j)).
        for i in range(n if self.wander else 0):
            for j in range(i, n):
                power, below = 2 * n - 1 - i - j, math.factorial(n - 1 - i) * math.factorial(n - 1 - j)
                found.append((i, j, power, self.wander / (below * power)))
        return tuple(found)

    def start(self, like: Tensor) -> TrackState:
        """The state of rows of which nothing is known, in the batch, type and device of ``like`` (*B, D)."""
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
        """The state after one measurement in each row, or none where its time is NaN; differentiable.

        Args:
            state: before.
            time: ``(*B,)`` when it was taken [s].
            pos: ``(*B, D)`` [m, world].
            now: ``(*B,)`` the present [s].
            variance: ``(*B,)`` of its error along each axis [m²]; the square of ``noise`` for None.

        Raises:
            InputError: a shape is wrong.
        """
        coordinates, _ = _sizes(state.motion)
        if pos.shape != (*time.shape, coordinates) or time.shape != state.time.shape:
            check_trailing_shape("time of a measurement", time, *state.time.shape)
            check_trailing_shape("pos of a measurement", pos, *state.time.shape, coordinates)
        looks = not hides_values(time)
        # A camera is slower than the loop: at most steps nothing comes.
        if looks and _is_nothing(debug_unwrap(time)):
            return state
        measured = Measurement(time, pos, self.noise**2 if variance is None else variance)
        if looks and _is_in_order(debug_unwrap(state.time), debug_unwrap(time), debug_unwrap(now)):
            expected = self._expect_next(state, measured)
            # The least of what is no number is no number, which is not above zero.
            if debug_unwrap(self._slack(expected)).min().item() >= 0.0:
                return self._used(state, expected, time)
            return self._sorted(state, measured, now, self._fit(expected).all(0))
        expected = self._expect(state, measured)
        # A comparison with what is no number, or with a row of which nothing is known, is false.
        fits = (self._fit(expected).all(0) & (expected.passed >= -self.oldest)) & (time <= now + CLOCKS)
        if not hides_values(fits) and debug_unwrap(fits).all():
            return self._used(state, expected, torch.maximum(state.time, time))
        return self._sorted(state, measured, now, fits)

    def at(self, state: TrackState, now: Tensor) -> TrackState:
        """The state brought forward to ``now`` (*B,) [s], without a measurement: where the target is by now."""
        now = torch.maximum(now, state.time)
        passed = torch.where(state.used > 0, now - state.time, 0.0)
        return state._replace(motion=_packed(*self._ahead(state, passed)), time=now)

    def usable(self, state: TrackState, now: Tensor) -> Tensor:
        """Whether there is a track to go by ``now`` (*B,) [s]: ``(*B,)`` bool."""
        return (state.used >= self.least) & (now - state.time <= self.patience)

    def _expect_next(self, state: TrackState, measured: Measurement) -> Prediction:
        """`_expect` where no row's measurement is late: the same in fewer operations, and most often all that is."""
        time, pos, error = measured
        passed = time - state.time
        mean, covariance = self._ahead(state, passed)
        own = covariance[0][0]
        variance = own + error if isinstance(error, Tensor) else torch.add(own, ONE, alpha=error)
        return Prediction(mean, covariance, passed, covariance[0], pos.movedim(-1, 0) - mean[0], variance)

    def _ahead(self, state: TrackState, passed: Tensor) -> tuple[list[Tensor], list[list[Tensor]]]:
        """Mean and covariance ``passed`` (*B,) seconds after the state, not before it."""
        mean, covariance = _unpacked(state.motion)
        if self.order == 2:
            place, velocity = mean
            return [torch.addcmul(place, passed, velocity), velocity], self._spread(covariance, passed)
        forward = _factors(passed, self.order)
        return [_sum(mean[i:], forward) for i in range(self.order)], self._spread(covariance, passed)

    def _expect(self, state: TrackState, measured: Measurement) -> Prediction:
        """What is expected in place of what was measured."""
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
            # What may have happened since a late measurement was taken makes it less sure.
            _, _, power, factor = self._drift[0]
            scale = torch.add(scale, _power(-behind, power), alpha=factor)
        forward = _factors(ahead, self.order)
        mean = [_sum(mean[i:], forward) for i in range(self.order)]
        return Prediction(mean, covariance, passed, lever, innovation, scale)

    def _spread(self, covariance: list[list[Tensor]], ahead: Tensor) -> list[list[Tensor]]:
        """The covariance ``ahead`` (*B,) seconds later: F P Fᵀ + Q, with F that of n integrators in a row."""
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
        """Whether a measurement is where it was expected, along each axis ``(D, *B)`` bool."""
        return self._slack(expected) >= 0.0

    def _used(self, state: TrackState, expected: Prediction, newest: Tensor) -> TrackState:
        """The state at ``newest`` (*B,) [s] after measurements that fit in all rows: the Kalman filter's correction."""
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
        """`add` where rows differ: in some the motion begins, in some there is no measurement, or a useless one."""
        time, pos, _ = measured
        given, known = ~time.isnan(), state.used > 0
        usable = (pos.abs().amax(-1) <= LARGEST) & (time <= now + CLOCKS) & (time.abs() <= LARGEST)
        usable = usable & ~(time < state.time - self.oldest)
        # What is no number must not reach what is computed of rows that do not use it: gradients would see it.
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
        """The state where a motion begins with a measurement, after a bounce or, in rows ``lost`` (*B,), from nothing.

        What bounced has turned round along the axes in which the measurement does not fit.
        """
        time, pos, variance = measured
        where, velocity = pos.movedim(-1, 0), expected.mean[1]
        turned = velocity * torch.where(self._fit(expected), 1.0, -self.rebound)
        turned = torch.where(lost, 0.0, turned)
        before = [torch.where(lost, new, old) for new, old in zip([where, turned], expected.mean, strict=False)]
        return TrackState(
            motion=_packed([where, turned, *map(torch.zeros_like, expected.mean[2:])], self._unsure(time, variance)),
            time=time,
            begin=torch.where(lost, time, state.begin),
            since=time,
            before=torch.cat(before).movedim(0, -1),
            used=torch.where(lost, 0, state.used) + 1,
            restarts=state.restarts + (state.used > 0),
            rejected=state.rejected,
        )

    def _unsure(self, like: Tensor, variance: Tensor | float) -> list[list[Tensor]]:
        """Covariance where a position with ``variance`` (*B,) is known, and nothing else; for ``like`` (*B,)."""
        zero = torch.zeros_like(like).unsqueeze(0)
        spreads = [zero + variance, *(zero + deviation**2 for deviation in self._unknown)]
        return [[spreads[i], *[zero] * (self.order - 1 - i)] for i in range(self.order)]

    @property
    def _unknown(self) -> list[float]:
        """Standard deviations of velocity and further derivatives of which nothing is known."""
        return [self.speed]


@dataclass(frozen=True, kw_only=True)
class KalmanTrack(Track):
    """The Kalman filter of a target that moves at constant velocity, or acceleration, but for what accelerates it."""

    agility: float = 0.1
    """After t seconds without a measurement the last derivative may have changed by ``agility``·√t: root of the
    spectral density of what changes it [m/s² per √Hz; with ``accelerates`` m/s³]."""
    accelerates: bool = False
    """Whether the acceleration is constant, and not the velocity."""
    acceleration: float = 1.0
    """Standard deviation of the acceleration of a target of which nothing is known [m/s²]; with ``accelerates``."""

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
class LeastSquaresTrack(Track):
    """A straight line by least squares through the measurements, of which older ones count less: as e^(-age/window)."""

    window: float = 0.1
    """Time over which a measurement's weight falls to 1/e [s]."""

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


def _is_nothing(time: Tensor) -> bool:
    """Whether no row has a measurement, by their times (*B,)."""
    if time.numel() != 1:
        return bool(time.isnan().all())
    # A number of Python's own takes less time to compare than a tensor.
    return math.isnan(time.item())


def _is_in_order(before: Tensor, time: Tensor, now: Tensor) -> bool:
    """Whether every row has a measurement, not from ``before`` (*B,) that row's newest one, nor from the future."""
    if time.numel() != 1:
        return bool(((time >= before) & (time <= now + CLOCKS)).all())
    return before.item() <= time.item() <= now.item() + CLOCKS


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
    """The motion ``(*B, Dn + n(n+1)/2)``; in memory its components come first, which makes them cheap to take apart."""
    return torch.cat([*mean, *(entry for row in covariance for entry in row)]).movedim(0, -1)


def _whole(triangle: list[list[Tensor]]) -> list[list[Tensor]]:
    """The rows of a symmetric matrix of which the upper triangle is given."""
    n = len(triangle)
    return [[triangle[min(i, j)][abs(i - j)] for j in range(n)] for i in range(n)]


def _factors(time: Tensor, n: int) -> list[Tensor]:
    """t, t²/2 … of ``time``, n - 1 of them: what the derivatives add meanwhile."""
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
    """``value`` multiplied by itself: cheaper than a power, and its derivative at 0 is a number."""
    found = value
    for _ in range(exponent - 1):
        found = found * value
    return found


def _with_power(value: Tensor, powers: list[Tensor], power: int, factor: float) -> Tensor:
    """``value`` + ``factor`` t^``power``, from the ``powers`` t, t² … of which two make it."""
    if power == 1:
        return torch.add(value, powers[0], alpha=factor)
    half = power // 2
    return torch.addcmul(value, powers[half - 1], powers[power - half - 1], value=factor)


def _polynomial(motion: Tensor, passed: Tensor, coordinates: int) -> Tensor:
    """Positions ``(*B, T, D)`` after ``passed`` (*B, T) [s] from position, velocity … ``(*B, Dn)``."""
    terms = motion.unsqueeze(-2).split(coordinates, dim=-1)
    return _sum(terms, _factors(passed.unsqueeze(-1), len(terms)))
