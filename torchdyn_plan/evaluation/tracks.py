"""Tracks by name, for the command line."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from torchdyn_plan.checks import check_choice
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import BallisticTrack, KalmanTrack, LeastSquaresTrack, Track

NO_TRACK = "none"
"""The planner sees the newest measurement, held from step to step."""
TRACKS: Mapping[str, type[Track]] = {
    "least_squares": LeastSquaresTrack,
    "kalman": KalmanTrack,
    "ballistic": BallisticTrack,
}
"""Filters that may stand between sensor and planner."""
LEAST_NOISE = 1e-4
"""Lower bound on a track's ``noise`` [m], because targets do not move as smoothly as the filter's model."""


def track_named(name: str, sensor: Sensor | None = None, **settings: Any) -> Track | None:
    """The track of that name, None for ``none``.

    Args:
        name: ``none``, or one of `TRACKS`.
        sensor: sensor in front of it, an exact one for None; its error is the track's ``noise`` unless given.
        settings: settings of the track by name; the others keep their defaults.

    Raises:
        InputError: there is no such track, it has no such setting, or a number is out of range.
    """
    check_choice("track", name, [NO_TRACK, *TRACKS])
    if name == NO_TRACK:
        if settings:
            raise InputError(f"{', '.join(settings)} of a track, but there is none: choose {' or '.join(TRACKS)}")
        return None
    kind = TRACKS[name]
    for setting in settings:
        check_choice(f"setting of track {name}", setting, [one.name for one in dataclasses.fields(kind)])
    noise = LEAST_NOISE if sensor is None else max(sensor.deviation, LEAST_NOISE)
    return kind(**{"noise": noise, **settings})
