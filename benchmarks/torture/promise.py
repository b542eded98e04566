"""What a promise is, and what becomes of its cases."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from torchdyn_plan.errors import TorchdynPlanError

SHOWN = 20
"""Faults of a promise that are told; all are counted."""

Cases = Iterator[str | None]
"""For each case None, or what went wrong."""


@dataclass(frozen=True, kw_only=True)
class Promise:
    """Something that must hold in every case."""

    says: str
    """In one sentence."""
    cases: Callable[[Random, Path, int], Cases]
    """Tries about so many cases, drawn at random, in an empty folder."""
    count: int
    """How many at full size."""

    def run(self, draw: Random, folder: Path, size: float) -> dict[str, Any]:
        """How many cases there were, and the faults."""
        started, tried, faults = time.monotonic(), 0, []
        for fault in self.cases(draw, folder, max(1, round(self.count * size))):
            tried += 1
            faults += [] if fault is None else [fault]
        seconds = round(time.monotonic() - started, 1)
        return {"cases": tried, "faults": len(faults), "told": faults[:SHOWN], "seconds": seconds}


class Outcome(NamedTuple):
    """How a call ended."""

    value: Any
    """What it returned; None where it raised."""
    refused: TorchdynPlanError | None
    """The project's own error."""
    foreign: str | None
    """Any other error, in one line."""


def attempt(call: Callable[..., Any], *arguments: Any, **settings: Any) -> Outcome:
    """Call, and tell how it ended."""
    try:
        return Outcome(call(*arguments, **settings), None, None)
    except TorchdynPlanError as error:
        return Outcome(None, error, None)
    except Exception as error:
        return Outcome(None, None, in_a_line(error))


def in_a_line(error: BaseException) -> str:
    """An error in one short line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"
