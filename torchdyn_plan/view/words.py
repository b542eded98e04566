"""Texts about a recording: at each control step, and at its end."""

from __future__ import annotations

from torchdyn_plan.planners import PlanStatus
from torchdyn_plan.view.recording import NOTHING, Recording

STATUS = {
    PlanStatus.OK: "in time",
    PlanStatus.WAITING: "waits for its first plan",
    PlanStatus.UNREACHABLE: "cannot be in time anywhere",
    PlanStatus.BAD_FORECAST: "bad forecast",
    PlanStatus.TARGET_LOST: "target lost",
    PlanStatus.BAD_INPUT: "bad input",
    PlanStatus.NO_TRACK: "no track of the target",
}
"""A short text for each status."""


def clock(recording: Recording, step: int) -> str:
    """The time since the reset."""
    return f"{step * recording.scenario.task.control_step:.2f} s"


def plan_line(recording: Recording, step: int) -> str:
    """State of the plan: the countdown to the meeting, and the status."""
    status = int(recording.status[step])
    if status == NOTHING:
        return "makes no plans"
    said = STATUS[PlanStatus(status)]
    if status != PlanStatus.OK:
        return said
    seconds = recording.countdown[step] * recording.scenario.task.control_step
    return f"meets in {seconds:.2f} s, {said}"


def outcome(recording: Recording) -> str:
    """Outcome of the episode: the time of its success, or the cause of its failure."""
    after = clock(recording, recording.length)
    if recording.success:
        return f"{recording.scenario.task.words.success} after {after}"
    cause = recording.cause.replace("_", " ")
    return f"failed after {after}" + (f": {cause}" if cause else "")


def caption(recording: Recording, step: int) -> str:
    """One line below a picture."""
    if step >= recording.length:
        return outcome(recording)
    return f"{clock(recording, step)}  {plan_line(recording, step)}"
