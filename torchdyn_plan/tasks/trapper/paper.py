"""The paper's success rates, read off its Figure 4, for comparison with ours."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from torchdyn_plan.evaluation.curves import Curve, PaperLine, PaperMoments, PaperPanel, rate_at
from torchdyn_plan.tasks.trapper.task import TrapperSettings

FRICTION_VELOCITY = 3.0
"""Velocity of the ball in the paper's friction sweep [m/s]."""

_NAMES = {"corner": "dynamic", "pursuit": "pursuit", "oracle": "oracle"}
"""Our names of the paper's planners, and the words that its curves carry."""
_SCENE = "paper"
"""Scene in which our results stand beside the paper's."""
_STATICS = {"ik": "IK", "rl": "RL"}
_EPISODE = 500
"""Control steps of the episode whose plans are marked on the number line."""


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

    def panels(self) -> list[PaperPanel | PaperMoments]:
        """Figure 4 whole and for each static planner alone, there with *wait and drop*, and Figure 5's number line."""
        own = {static: _lines(static) for static in _STATICS}
        planned = {"paper": _figures()["replan_steps"], "ours": _planned_steps()}
        number_line = PaperMoments("figure5", (0, 0), "Re-plans of an episode", "control step", _EPISODE, planned)
        return [
            *_figure4("figure4", tuple(line for lines in own.values() for line in lines)),
            *(
                panel
                for static, name in _STATICS.items()
                for panel in _figure4(
                    f"figure4_{static}", (*own[static], PaperLine("wait_and_drop", static, f"wait and drop, {name}"))
                )
            ),
            number_line,
        ]


def _lines(static: str) -> tuple[PaperLine, ...]:
    """The paper's three planners on a static planner."""
    words = {"corner": "dynamic planner (corner)", "pursuit": "target pursuit", "oracle": "oracle trajectory"}
    return tuple(PaperLine(planner, static, f"{text}, {_STATICS[static]}") for planner, text in words.items())


def _figure4(figure: str, lines: tuple[PaperLine, ...]) -> list[PaperPanel]:
    """Velocity above, friction below; all episodes on the left, solvable ones on the right."""
    rows = {"velocity": {"friction": 0.0}, "friction": {"velocity": FRICTION_VELOCITY}}
    return [
        PaperPanel(
            figure=figure,
            place=(row, column),
            title=f"{'Solvable' if column else 'All'} episodes, over {over}",
            over=over,
            settings=settings,
            lines=lines,
            solvable=bool(column),
            scene=_SCENE,
        )
        for row, (over, settings) in enumerate(rows.items())
        for column in (0, 1)
    ]


def _planned_steps() -> list[int]:
    """Control steps at which the paper's schedule plans, as it is built here."""
    import torch

    from torchdyn_plan.planners import ReplanSchedule

    schedule = ReplanSchedule()
    steps, step, window = [], schedule.first_step, torch.tensor(schedule.window)
    while step < _EPISODE:
        steps.append(step)
        window = schedule.next_window(window)
        step += int(window)
    return steps


@cache
def _figures() -> dict[str, Any]:
    return json.loads(files("torchdyn_plan.tasks.trapper").joinpath("paper_curves.json").read_text())
