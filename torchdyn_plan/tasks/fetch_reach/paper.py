"""The paper's success rates, read off its Figure 5, for comparison with ours."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from torchdyn_plan.evaluation.curves import Curve, PaperLine, PaperPanel, rate_at
from torchdyn_plan.tasks.fetch_reach.task import FetchReachSettings

_NAMES = {"corner": "dynamic", "dher": "dher"}
"""Our names of the paper's planner and its rival, and the words that their curves carry."""


class FetchReachCurves:
    """`torchdyn_plan.tasks.task.PaperCurves` of Dynamic FetchReach: goals of any velocity that move straight.

    The paper says neither which static planner it used here, nor how many of the episodes can be solved.
    """

    def rate(self, planner: str, static: str, settings: FetchReachSettings, *, solvable: bool) -> float | None:
        """As `PaperCurves.rate`."""
        curve = self.curve(planner, static, "velocity", settings, solvable=solvable)
        return None if curve is None else rate_at(curve, settings.velocity)

    def curve(
        self, planner: str, static: str, over: str, settings: FetchReachSettings, *, solvable: bool
    ) -> Curve | None:
        """As `PaperCurves.curve`."""
        curve = _figures()["velocity"].get(_NAMES.get(planner))
        if curve is None or solvable or over != "velocity" or settings.motion != "straight":
            return None
        return curve["x"], curve["y"]

    def panels(self) -> list[PaperPanel]:
        """The right half of Figure 5."""
        lines = (
            PaperLine("corner", "proportional", "dynamic planner (corner)"),
            PaperLine("dher", "proportional", "DHER"),
        )
        title = "Dynamic FetchReach, all episodes"
        return [PaperPanel("figure5", (0, 1), title, "velocity", {}, lines)]


@cache
def _figures() -> dict[str, Any]:
    return json.loads(files("torchdyn_plan.tasks.fetch_reach").joinpath("paper_curves.json").read_text())
