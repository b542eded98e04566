"""Recorded paths as a planner sees them: measured by simulated sensors, and tracked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.track import Track, TrackState
from torchdyn_plan.training.windows import Paths

BLOCK = 2048
"""Paths tracked at once."""
NEVER = -1
"""Arrival step of a lost measurement."""


class SensorRows(NamedTuple):
    """A sensor for each of M paths, with the settings of `torchdyn_plan.envs.Sensor`."""

    noise: Tensor
    """``(M,)`` [m]."""
    rate: Tensor
    """``(M,)`` [Hz]."""
    latency: Tensor
    """``(M,)`` [s]."""
    jitter: Tensor
    """``(M,)`` [s]."""
    dropout: Tensor
    """``(M,)`` share of lost measurements."""

    @classmethod
    def of(cls, sensor: Sensor, count: int, control_step: float) -> SensorRows:
        """The same ``sensor`` for ``count`` paths; raises `InputError` if it quantises."""
        if sensor.quantisation:
            raise InputError(f"paths are measured without quantisation, got {sensor.quantisation:g} m")
        values = (sensor.noise, sensor.rate or 1.0 / control_step, sensor.latency, sensor.jitter, sensor.dropout)
        return cls(*(torch.full((count,), float(value)) for value in values))


@dataclass(frozen=True, kw_only=True)
class SensorRange:
    """Range of sensors that a forecaster is trained for; one sensor is drawn for each path."""

    noise: float = 0.008
    """Largest standard deviation of a measurement's error along each axis [m]; smaller ones are likelier."""
    slowest: float = 30.0
    """Lowest rate [Hz]."""
    fastest: float = 250.0
    """Highest rate [Hz]."""
    latency: float = 0.04
    """Longest time from a measurement to its arrival [s]."""
    jitter: float = 0.004
    """Largest standard deviation of measurement times, at most a fifth of the time between two [s]."""
    dropout: float = 0.1
    """Largest share of lost measurements."""
    plain: float = 0.25
    """Share of sensors without latency, jitter and dropout."""

    def __post_init__(self) -> None:
        for name in ("noise", "latency", "jitter"):
            check_number(name, getattr(self, name), minimum=0.0, maximum=1.0)
        check_number("slowest", self.slowest, minimum=1.0)
        check_number("fastest", self.fastest, minimum=self.slowest)
        for name in ("dropout", "plain"):
            check_number(name, getattr(self, name), minimum=0.0, maximum=1.0)

    def draw(self, count: int, generator: torch.Generator) -> SensorRows:
        """``count`` sensors: noise denser near 0, rates log-uniform, everything else uniform."""
        noise, rate, latency, jitter, dropout, kind = torch.rand((6, count), generator=generator)
        rate = self.slowest * (self.fastest / self.slowest) ** rate
        real = (kind >= self.plain).float()
        return SensorRows(
            noise=self.noise * noise.square(),
            rate=rate,
            latency=self.latency * latency * real,
            jitter=torch.minimum(self.jitter * jitter, 0.2 / rate) * real,
            dropout=self.dropout * dropout * real,
        )


class Measured(NamedTuple):
    """Measurements of M targets at each of T control steps: at most one, the newest that arrives."""

    time: Tensor
    """``(M, T)`` time stamp; NaN for none [s since the reset]."""
    pos: Tensor
    """``(M, T, 3)`` [m, world]."""


class Sightings(NamedTuple):
    """States of a track for n targets, at times at which it is usable."""

    episode: Tensor
    """``(n,)`` int64 index of the path."""
    present: Tensor
    """``(n,)`` int64 control step."""
    state: TrackState
    """``(n, …)`` state of the track."""
    covariance: Tensor
    """``(n, 2, 2)`` of position and velocity along each axis at that step [m², m²/s; m²/s, m²/s²]."""

    def history(self, length: int, control_step: float) -> Tensor:
        """Positions ``(n, H, 3)`` at the last ``length`` control steps, according to the track [m, world]."""
        ago = torch.arange(1 - length, 1)
        return self.state.path(control_step * (self.present.unsqueeze(-1) + ago).to(self.state.motion.dtype))

    def take(self, rows: Tensor) -> Sightings:
        """The sightings ``rows``."""
        state = TrackState(*(value[rows] for value in self.state))
        return Sightings(self.episode[rows], self.present[rows], state, self.covariance[rows])

    @classmethod
    def joined(cls, parts: Sequence[Sightings]) -> Sightings:
        """Concatenate them."""
        states = zip(*(part.state for part in parts), strict=True)
        state = TrackState(*(torch.cat(values) for values in states))
        episode, present, covariance = (
            torch.cat([getattr(part, name) for part in parts]) for name in ("episode", "present", "covariance")
        )
        return cls(episode, present, state, covariance)


def measure(
    paths: Paths, episodes: Tensor, sensors: SensorRows, steps: int, *, control_step: float, generator: torch.Generator
) -> Measured:
    """Measurements of the paths of ``episodes`` (M,) that arrive at control steps 0 … ``steps``.

    If several arrive at one control step, the newest is used. A lost target stays where it was lost.

    Args:
        paths: recorded paths, one position per control step.
        episodes: ``(M,)`` int64.
        sensors: a sensor for each path.
        steps: last control step.
        control_step: [s].
        generator: source of all errors and losses.
    """
    period = 1.0 / sensors.rate.double()
    count = int(steps * control_step * float(sensors.rate.max()) + 1e-9) + 1
    shape = len(episodes), count
    chance = torch.randn(shape, generator=generator, dtype=torch.float64)
    taken = (torch.arange(count) * period.unsqueeze(-1) + chance * sensors.jitter.unsqueeze(-1)).clamp_min(0.0)
    lost = torch.rand(shape, generator=generator) < sensors.dropout.unsqueeze(-1)
    error = torch.randn((*shape, 3), generator=generator) * sensors.noise[:, None, None]
    # The first one is available at the reset, and never lost.
    taken[:, 0], lost[:, 0] = 0.0, False
    seen = torch.ceil((taken + sensors.latency.unsqueeze(-1)) / control_step - 1e-9).long()
    seen[:, 0] = 0
    pos = _places(paths, episodes, taken / control_step) + error
    found = Measured(
        torch.full((len(episodes), steps + 1), torch.nan), torch.full((*shape[:1], steps + 1, 3), torch.nan)
    )
    newest = torch.full((len(episodes), steps + 1), NEVER)
    there = ~lost & (seen <= steps)
    newest.scatter_reduce_(
        1, torch.where(there, seen, 0), torch.arange(count).expand(shape).masked_fill(~there, NEVER), "amax"
    )
    rows, at = (newest > NEVER).nonzero(as_tuple=True)
    number = newest[rows, at]
    found.time[rows, at], found.pos[rows, at] = taken[rows, number].float(), pos[rows, number]
    return found


def _places(paths: Paths, episodes: Tensor, when: Tensor) -> Tensor:
    """Positions ``(M, K, 3)`` [m, world] of ``episodes`` (M,) at times ``when`` (M, K) [control steps]."""
    before = when.floor().long()
    first, last = paths.start[episodes].unsqueeze(-1), (paths.length[episodes] - 1).unsqueeze(-1)
    old, new = (paths.positions[first + torch.minimum(before + more, last)] for more in (0, 1))
    return torch.lerp(old, new, (when - before).float().unsqueeze(-1))


def follow(
    track: Track, measured: Measured, sensors: SensorRows, *, control_step: float, least_noise: float
) -> tuple[TrackState, Tensor, Tensor]:
    """Run ``track`` over all control steps, as in a control loop.

    Args:
        track: the planner's track; its noise is set to each sensor's, but at least to ``least_noise`` [m].
        measured: measurements of M targets at T control steps.
        sensors: the sensors that took them.
        control_step: [s].
        least_noise: see above.

    Returns:
        The states ``(M, T, …)``, the covariance ``(M, T, 2, 2)`` of position and velocity at each step, and whether the
        track is usable ``(M, T)`` bool.
    """
    variance = sensors.noise.clamp_min(least_noise).square()
    state, found = track.start(measured.pos[:, 0]), []
    for step in range(measured.time.shape[-1]):
        now = torch.full_like(measured.time[:, 0], step * control_step)
        state = track.add(state, measured.time[:, step], measured.pos[:, step], now, variance=variance)
        found.append((*state, track.at(state, now).covariance, track.usable(state, now)))
    *fields, covariance, usable = (torch.stack(values, dim=1) for values in zip(*found, strict=True))
    return TrackState(*fields), covariance, usable


def record_sightings(
    paths: Paths,
    last_step: Tensor,
    episodes: Tensor,
    track: Track,
    sensors: SensorRange | Sensor,
    *,
    steps: int,
    each: int,
    control_step: float,
    least_noise: float,
    generator: torch.Generator,
) -> Sightings:
    """``each`` sightings of every one of ``episodes`` (M,), at random control steps at which the track is usable.

    Args:
        paths: recorded paths.
        last_step: ``(E,)`` latest step used of each path.
        episodes: ``(M,)`` int64.
        track: the planner's track.
        sensors: range from which each path's sensor is drawn, or one sensor for all.
        steps: latest step used of any path.
        each: number of sightings of a path.
        control_step: [s].
        least_noise: see `follow`.
        generator: source of every draw.
    """
    parts = []
    for block in episodes.split(BLOCK):
        drawn = (
            SensorRows.of(sensors, len(block), control_step)
            if isinstance(sensors, Sensor)
            else sensors.draw(len(block), generator)
        )
        measured = measure(paths, block, drawn, steps, control_step=control_step, generator=generator)
        state, covariance, usable = follow(track, measured, drawn, control_step=control_step, least_noise=least_noise)
        last = last_step[block].clamp(min=0, max=steps).unsqueeze(-1)
        chance = torch.rand((len(block), each), generator=generator)
        # Squared, so that presents are denser while targets are still fast.
        present = (chance.square() * (last + 1)).long()
        row = torch.arange(len(block)).unsqueeze(-1).expand_as(present)
        kept = usable[row, present] & (present <= last)
        row, present = row[kept], present[kept]
        seen = TrackState(*(value[row, present] for value in state))
        parts.append(Sightings(block[row], present, seen, covariance[row, present]))
    return Sightings.joined(parts)
