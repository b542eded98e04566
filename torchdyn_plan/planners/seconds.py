"""Conversion of times in seconds to control steps."""

from __future__ import annotations

import math

from torchdyn_plan.checks import check_number

ROUNDING = 1e-6
"""Share of a control step treated as rounding error."""


def steps_in(name: str, seconds: float, control_step: float) -> int:
    """Smallest number of control steps of ``control_step`` [s] that cover ``seconds`` [s]; ``name`` is for errors.

    Raises:
        InputError: a time is no number, is negative, or ``control_step`` is not positive.
    """
    check_number("control_step", control_step, minimum=1e-6)
    check_number(name, seconds, minimum=0.0, maximum=1e6)
    return math.ceil(seconds / control_step - ROUNDING)
