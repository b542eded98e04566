"""Recorded paths as training windows for a forecaster behind a track, with many simulated sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.planners.track import KalmanTrack, Track
from torchdyn_plan.training.lines import Lines
from torchdyn_plan.training.path_data import SCORED, PathSamples
from torchdyn_plan.training.sightings import SensorRange, Sightings, record_sightings
from torchdyn_plan.training.windows import Paths, WindowConfig, Windows

LOOK_BACK = 25
"""A track that moves opposite to its target has missed a bounce within this many control steps."""
REGIMES = {
    "exact": Sensor(),
    "2 mm, 250 Hz": Sensor(noise=0.002),
    "5 mm, 60 Hz, 20 ms late": Sensor(noise=0.005, rate=60.0, latency=0.02),
    "5 mm, 30 Hz, 5 % lost, 3 ms jitter": Sensor(noise=0.005, rate=30.0, dropout=0.05, jitter=0.003),
    "8 mm, 30 Hz, 40 ms late": Sensor(noise=0.008, rate=30.0, latency=0.04),
}
"""Sensors for which forecasts and their spread are scored, by name."""


@dataclass(frozen=True, kw_only=True)
class Sighting:
    """How a forecaster behind a track is trained."""

    track: Callable[[], Track] = KalmanTrack
    """Makes the planner's track; its noise is set to each sensor's."""
    sensors: SensorRange = field(default_factory=SensorRange)
    """Range of the sensors that measure the recorded paths."""
    regimes: Mapping[str, Sensor] = field(default_factory=lambda: dict(REGIMES))
    """Sensors for which it is scored, by name."""
    least_noise: float = 1e-4
    """Lower bound on a track's noise [m]."""
    steps: int = 500
    """Latest step used of a path [control steps since its reset]."""
    passes: int = 4
    """Number of sensors that measure each path."""
    each: int = 32
    """Number of track states kept of a path, in each pass."""

    def __post_init__(self) -> None:
        check_number("least_noise", self.least_noise, minimum=1e-6)
        for name in ("steps", "passes", "each"):
            check_number(name, getattr(self, name), minimum=1, integer=True)


@dataclass(frozen=True)
class SightedSamples:
    """Sightings of the training paths, and the paths; with the interface of `PathSamples`."""

    samples: PathSamples
    sightings: Sightings
    """Sightings of the training paths."""
    sighting: Sighting
    control_step: float
    """[s]."""

    @classmethod
    def load(
        cls, folder: Path, drawing: WindowConfig, seed: int, sighting: Sighting, *, control_step: float
    ) -> SightedSamples:
        """The paths in ``folder``, measured and tracked; ``seed`` determines every draw. Raises `InputError`."""
        samples = PathSamples.load(folder, drawing, seed)
        draws = torch.Generator().manual_seed(seed)
        episodes = samples.train.repeat(sighting.passes)
        found = cls(samples, _none(), sighting, control_step)
        return cls(samples, found.record(episodes, sighting.sensors, sighting.each, draws), sighting, control_step)

    @property
    def paths(self) -> Paths:
        """All of them."""
        return self.samples.paths

    @property
    def held(self) -> Tensor:
        """Episodes that are held out."""
        return self.samples.held

    @property
    def drawing(self) -> WindowConfig:
        """How windows are drawn."""
        return self.samples.drawing

    def record(
        self, episodes: Tensor, sensors: SensorRange | Sensor, each: int, generator: torch.Generator
    ) -> Sightings:
        """``each`` sightings of every one of ``episodes`` (M,), each with its own sensor, or all with one."""
        return record_sightings(
            self.paths,
            self.samples.last,
            episodes,
            self.sighting.track(),
            sensors,
            steps=self.sighting.steps,
            each=each,
            control_step=self.control_step,
            least_noise=self.sighting.least_noise,
            generator=generator,
        )

    def draw(self, count: int, generator: torch.Generator, *, lines: Lines | None = None) -> Windows:
        """``count`` random training windows, with futures on ``lines`` if given."""
        rows = torch.randint(len(self.sightings.episode), (count,), generator=generator)
        return self.windows(self.sightings.take(rows), lines=lines)

    def held_windows(self, seed: int) -> Windows:
        """Windows of held-out episodes from all regimes."""
        return Windows.joined(list(self.regimes(seed).values()))

    def regimes(self, seed: int) -> dict[str, Windows]:
        """Windows of held-out episodes, about `SCORED` of each regime, by its name."""
        draws = torch.Generator().manual_seed(seed + 1)
        each = -(-SCORED // len(self.held))
        found = {}
        for name, sensor in self.sighting.regimes.items():
            seen = self.record(self.held, sensor, each, draws)
            found[name] = self.windows(seen.take(torch.randperm(len(seen.episode), generator=draws)[:SCORED]))
        return found

    def windows(self, seen: Sightings, *, lines: Lines | None = None) -> Windows:
        """Windows of the targets ``seen``, with futures on ``lines`` if given."""
        paths, config = self.paths, self.drawing
        first, last = paths.start[seen.episode], paths.length[seen.episode] - 1
        ahead = torch.arange(1, config.horizon + 1) + seen.present.unsqueeze(-1)
        recorded = ahead <= last.unsqueeze(-1)
        index = first.unsqueeze(-1) + torch.minimum(ahead, last.unsqueeze(-1))
        history, now = seen.history(config.history, self.control_step), first + seen.present
        if lines is None:
            future = paths.positions[index]
        else:
            side, shift = stretch_of(
                lines, now, torch.minimum(seen.present, seen.present.new_tensor(LOOK_BACK)), history
            )
            future = lines.track[index]
            future[..., :2] = (future[..., :2] - shift.unsqueeze(-2)) * side.unsqueeze(-2)
        moves = paths.positions[now] - paths.positions[torch.maximum(now - 1, first)]
        since = ((seen.present * self.control_step - seen.state.begin) / self.control_step).round().long() + 1
        return Windows(
            history,
            since.clamp(max=config.history),
            future,
            recorded,
            paths.lost[seen.episode] & (last <= seen.present + config.horizon),
            moves.norm(dim=-1) > config.still_speed,
            seen.covariance,
        )


def stretch_of(lines: Lines, now: Tensor, back: Tensor, history: Tensor) -> tuple[Tensor, Tensor]:
    """Side and shift, ``(n, 2)`` each, of the stretch of table on which a track places its target.

    This is the target's own stretch, except along an axis in which it has bounced without the track showing it yet:
    there it is the stretch before the bounce.

    Args:
        lines: lines of all paths.
        now: ``(n,)`` index of each target's present.
        back: ``(n,)`` how many samples ago it may have bounced.
        history: ``(n, H, 3)`` positions according to the track [m, world].
    """
    before, heading = now - back, history[:, -1, :2] - history[:, -2, :2]
    # The line runs on in one direction; on a stretch its direction is multiplied by the side.
    runs = lines.track[now, :2] - lines.track[before, :2]
    unaware = (lines.side[now] != lines.side[before]) & (heading * runs * lines.side[before] > 0.0)
    side = torch.where(unaware, lines.side[before], lines.side[now])
    return side, torch.where(unaware, lines.shift[before], lines.shift[now])


def _none() -> Sightings:
    """No sightings."""
    track, empty = KalmanTrack(), torch.zeros(0, dtype=torch.int64)
    return Sightings(empty, empty, track.start(torch.zeros(0, 3)), torch.zeros(0, 2, 2))
