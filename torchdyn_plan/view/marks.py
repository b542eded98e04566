"""The plan's layers at a control step, drawn as ellipsoids over the world, for the page and for files.

Each layer has the same number of marks at every step of a recording; unused marks are invisible. Colours are those of
Okabe and Ito, which are safe for colour-blind readers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchdyn_plan.envs.look import Ball, Marks
from torchdyn_plan.view.insight import Insight
from torchdyn_plan.view.recording import Recording

YELLOW, BLUE, ORANGE, GREY = (0.94, 0.89, 0.26), (0.0, 0.45, 0.70), (0.84, 0.37, 0.0), (0.85, 0.85, 0.85)
RED, WHITE, PURPLE, SKY = (0.80, 0.05, 0.10), (1.0, 1.0, 1.0), (0.80, 0.47, 0.65), (0.34, 0.71, 0.91)
TRAIL, RIBBON, LATEST = 80, 75, 40
"""Most marks for the target's path so far, for its forecast, and for measurements."""
SLACK = 0.4
"""Slack at which a candidate's colour saturates [s]."""
FARTHEST = 2.0
"""Arrival time at which a point of the reachable region has faded [s]; points reached at once are opaque."""

LAYERS = ("region", "trail", "forecast", "candidates", "goal", "measurements", "track", "tool", "target")
"""Names of all layers; those for which a recording has nothing are left out of `marks_at`."""


def marks_at(recording: Recording, step: int) -> dict[str, Marks]:
    """The layers of control step ``step``, by name; sizes in hundredths of the look's half side."""
    unit, insight, look = recording.look.half_side / 100.0, recording.insight(step), recording.look
    found = {"trail": trail(recording, step, unit)}
    if recording.insights:
        # Before the first plan nothing is visible, with the same number of marks.
        shown = recording.insights[0] if insight is None else insight
        found["region"] = region(shown, recording.scenario.task.control_step, unit)
        found["forecast"] = ribbon(shown, step, unit)
        found["candidates"] = candidates(recording, shown, step, unit)
        if insight is None:
            for name in ("region", "forecast", "candidates"):
                found[name] = found[name]._replace(colours=np.zeros_like(found[name].colours))
    found["goal"] = dots(recording.goal[step : step + 1], 2.5 * unit, RED, 0.9)
    if np.isfinite(recording.measured_pos).any():
        found["measurements"] = measurements(recording, step, unit)
    if np.isfinite(recording.believed_pos).any():
        found["track"] = dots(recording.believed_pos[step : step + 1], 3.5 * unit, PURPLE, 0.7)
    for name, ball in (("tool", look.tool), ("target", look.target)):
        if ball is not None:
            found[name] = body(getattr(recording, f"{name}_pos")[step], ball)
    return {name: found[name] for name in LAYERS if name in found}


def trail(recording: Recording, step: int, unit: float) -> Marks:
    """The target's path until ``step``, fading with age."""
    stride = max(1, recording.length // TRAIL)
    number = np.arange(0, recording.length + 1, stride)
    past = number < step
    age = np.clip((step - number) / max(recording.length, 1), 0.0, 1.0)
    return dots(recording.target_pos[number], 0.7 * unit, WHITE, np.where(past, 0.9 - 0.7 * age, 0.0))


def ribbon(insight: Insight, step: int, unit: float) -> Marks:
    """The forecast from ``step`` on, as wide as its interval, and fainter the wider it is."""
    path, width = np_of(insight.path), np_of(insight.half_width)
    number = np.arange(0, len(path), max(1, len(path) // RIBBON))
    to_come, path = insight.begin + number + 1 > step, path[number]
    width = np.clip(np.nan_to_num(width[number], nan=0.0), 0.0, 30.0 * unit) + 0.8 * unit
    # This many marks overlap, and together they should be as faint as one.
    apart = np.linalg.norm(np.diff(path, axis=0), axis=1)
    apart = np.append(apart, apart[-1:] if len(apart) else 0.0)
    overlap = np.clip(2.0 * width.mean(axis=1) / np.maximum(apart, 1e-9), 1.0, len(path))
    opacity = 1.6 / (1.0 + width.mean(axis=1) / (3.0 * unit)) / overlap
    sizes = np.column_stack([width, np.full(len(number), 0.25 * unit)])
    return dots(path, sizes, YELLOW, np.where(to_come, np.clip(opacity, 0.02, 0.9), 0.0))


def candidates(recording: Recording, insight: Insight, step: int, unit: float) -> Marks:
    """Candidate meetings, blue if the robot would wait for the target and orange if it would be late."""
    most = max(len(one.goals) for one in recording.insights)
    slack = np_of(insight.slack) * recording.scenario.task.control_step
    opacity = np.where(insight.begin + np_of(insight.target_steps) < step, 0.0, 0.85)
    marks = dots(np_of(insight.goals), 1.1 * unit, slack_colours(slack), opacity)
    missing = most - len(slack)
    return Marks(*(np.pad(value, ((0, missing), (0, 0))) for value in marks))


def slack_colours(slack: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Colours ``(K, 3)`` of slacks (K,) [s]: blue for early, white for just in time, orange for late or never."""
    share = np.clip(np.nan_to_num(slack, neginf=-SLACK, posinf=SLACK) / SLACK, -1.0, 1.0)[:, None]
    end = np.where(share > 0.0, BLUE, ORANGE)
    return (1.0 - np.abs(share)) * np.array(WHITE) + np.abs(share) * end


def region(insight: Insight, control_step: float, unit: float) -> Marks:
    """The reachable region, fainter the longer it takes to get there."""
    seconds = np_of(insight.region_steps) * control_step
    opacity = np.where(np.isfinite(seconds), 0.6 - 0.5 * np.clip(seconds / FARTHEST, 0.0, 1.0), 0.0)
    sizes = np.array([[1.0, 1.0, 0.15]]) * unit
    return dots(np_of(insight.region), np.broadcast_to(sizes, (len(seconds), 3)), SKY, opacity)


def measurements(recording: Recording, step: int, unit: float) -> Marks:
    """The latest measurements of the target."""
    came = recording.measured_pos[: step + 1].reshape(-1, 3)
    came = came[np.isfinite(came).all(axis=1)][-LATEST:]
    filler = np.full((LATEST - len(came), 3), np.nan)
    return dots(np.concatenate([came, filler]), 1.0 * unit, PURPLE, 0.9)


def body(place: np.ndarray[Any, Any], ball: Ball) -> Marks:
    """A ball for a tool or target that the model does not contain."""
    return Marks.ball(tuple(place), *ball)


def dots(places: Any, sizes: Any, colour: Any, opacity: Any) -> Marks:
    """K marks at ``places`` (K, 2 or 3); sizes, colours and opacities for each or for all. NaN is invisible."""
    places = np.asarray(places, dtype=float)
    places = np.pad(places, ((0, 0), (0, 3 - places.shape[1])))
    known, count = np.isfinite(places).all(axis=1), len(places)
    sizes = np.full((count, 3), sizes) if np.ndim(sizes) == 0 else np.array(sizes, dtype=float)
    colours = np.column_stack([np.broadcast_to(colour, (count, 3)), np.broadcast_to(opacity, (count,))])
    return Marks(np.nan_to_num(places), sizes, colours * known[:, None])


def np_of(tensor: Any) -> np.ndarray[Any, Any]:
    """A tensor as an array of doubles."""
    return tensor.double().numpy()
