"""Times as people speak of them, in seconds, as the control steps that planners count."""

from __future__ import annotations

import math

from torchdyn_plan.checks import check_number

ROUNDING = 1e-6
"""Share of a control step that is rounding."""


def steps_in(name: str, seconds: float, control_step: float) -> int:
    """Fewest control steps of ``control_step`` [s] that take the time ``name`` of ``seconds`` [s].

    Raises:
        InputError: a time is no number, is negative, or ``control_step`` is not positive.
    """
    check_number("control_step", control_step, minimum=1e-6)
    check_number(name, seconds, minimum=0.0, maximum=1e6)
    return math.ceil(seconds / control_step - ROUNDING)
