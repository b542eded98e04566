"""The paper's success rates, read off its Figure 4, to stand beside ours."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from torchdyn_plan.evaluation.curves import Curve, rate_at
from torchdyn_plan.tasks.trapper.task import TrapperSettings

FRICTION_VELOCITY = 3.0
"""Velocity of the ball in the paper's friction sweep [m/s]."""

_NAMES = {"corner": "dynamic", "pursuit": "pursuit", "oracle": "oracle"}
"""Our names of the paper's planners, and the words that its curves carry."""


class TrapperCurves:
    """`torchdyn_plan.tasks.task.PaperCurves` of Trapper.

    The paper varied the ball's velocity without friction, and its friction loss at `FRICTION_VELOCITY`.
    """

    def rate(self, planner: str, static: str, settings: TrapperSettings, *, solvable: bool) -> float | None:
        """As `PaperCurves.rate`."""
        for over in ("velocity", "friction"):
            curve = self.curve(planner, static, over, settings, solvable=solvable)
            if curve is not None:
                return rate_at(curve, getattr(settings, over))
        return None

    def curve(self, planner: str, static: str, over: str, settings: TrapperSettings, *, solvable: bool) -> Curve | None:
        """As `PaperCurves.curve`."""
        ran = {"velocity": settings.friction == 0.0, "friction": settings.velocity == FRICTION_VELOCITY}
        if not ran.get(over):
            return None
        panel = _figures()[f"{over}_{'solvable' if solvable else 'all'}"]
        curve = panel.get(f"{_NAMES.get(planner)}_{static}")
        return None if curve is None else (curve["x"], curve["y"])


@cache
def _figures() -> dict[str, Any]:
    return json.loads(files("torchdyn_plan.tasks.trapper").joinpath("paper_curves.json").read_text())
