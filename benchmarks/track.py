"""Cost of a track: a step with a measurement, a step without, and the history and covariance for a forecaster.

    python benchmarks/track.py --out benchmarks/results/track.json

``operation`` is one addition of two tensors with one number per row, measured at the same time, as the cost of any
operation on the machine at that moment. On a shared machine the ratio to it is more meaningful than microseconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import tyro
from study import Output, Study, measuring
from torch import Tensor

from torchdyn_plan.bench.timing import figures, sample
from torchdyn_plan.planners import KalmanTrack, LeastSquaresTrack, Track, TrackState

TRACKS = {
    "kalman": KalmanTrack(noise=0.005),
    "kalman with acceleration": KalmanTrack(noise=0.005, accelerates=True),
    "least squares": LeastSquaresTrack(noise=0.005),
}
PERIOD, STEP, HISTORY = 1.0 / 30.0, 0.004, 24


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Which batches are measured."""

    batches: tuple[int, ...] = (1, 4096)
    """Rows at once."""
    seconds: float = 1.0
    """Time spent on each figure [s]."""


def followed(track: Track, batch: int, count: int = 30) -> tuple[TrackState, Tensor, Tensor]:
    """A track of so many measurements of straight motion, and the next one: its time (B,) and place (B, 3)."""
    draw = torch.Generator().manual_seed(0)
    start, velocity = torch.randn(2, batch, 3, generator=draw)
    state = track.start(start)
    for index in range(count + 1):
        time = torch.full((batch,), index * PERIOD)
        place = start + time.unsqueeze(-1) * velocity + 0.002 * torch.randn(batch, 3, generator=draw)
        if index < count:
            state = track.add(state, time, place, time)
    return state, time, place


def works(track: Track, batch: int) -> dict[str, Callable[[], object]]:
    """What is timed, by name."""
    state, time, place = followed(track, batch)
    nothing, some = torch.full_like(time, torch.nan), time.clone()
    some[::2] = torch.nan
    moments = time.unsqueeze(-1) + STEP * torch.arange(1 - HISTORY, 1)
    one = torch.rand(batch)
    found: dict[str, Callable[[], object]] = {
        "operation": lambda: one + one,
        "measurement in every row": lambda: track.add(state, time, place, time),
        "measurement in no row": lambda: track.add(state, nothing, place, time),
        "brought to now": lambda: track.at(state, time),
        "history": lambda: state.path(moments),
    }
    if batch > 1:
        found["measurement in every second row"] = lambda: track.add(state, some, place, time)
    return found


def main(arguments: Arguments) -> None:
    """Measure."""
    study = Study(arguments, resume=False)
    with measuring():
        for name, track in TRACKS.items():
            for batch in arguments.batches:
                for what, work in works(track, batch).items():
                    durations = sample(work, seconds=arguments.seconds)
                    best = round(1e6 * min(durations), 3)
                    study.add(
                        {"what": what, "track": name, "batch": batch, "best_us": best, **figures(durations, batch)}
                    )


if __name__ == "__main__":
    main(tyro.cli(Arguments))
