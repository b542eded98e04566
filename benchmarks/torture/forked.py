"""A command in a process of its own, which has imported everything: it begins at once, and can be killed at once."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

HUNG = -1
"""Code of a process that was stopped as it did not end."""


class Ended(NamedTuple):
    """A process that is over."""

    code: int
    """Its exit code; minus the number of the signal that killed it."""
    told: str
    """What it wrote on stderr."""
    seconds: float


def run(call: Callable[[], object], *, kill_after: float | None = None, at_most: float = 120.0) -> Ended:
    """Run ``call`` in a forked process.

    Args:
        call: what it does; an exception that it raises is a code of 1 and a traceback, as in a program.
        kill_after: send SIGKILL after so long [s].
        at_most: a process that still runs then hangs, and is killed [s].
    """
    reading, writing = os.pipe()
    started = time.monotonic()
    process = os.fork()
    if process == 0:
        os.close(reading)
        os._exit(_child(call, writing))
    os.close(writing)
    limit = at_most if kill_after is None else kill_after
    told, ended = _read(reading, started + limit)
    if not ended:
        os.kill(process, signal.SIGKILL)
        told += _read(reading, time.monotonic() + 10.0)[0]
    os.close(reading)
    _, status = os.waitpid(process, 0)
    code = os.waitstatus_to_exitcode(status)
    if not ended and kill_after is None:
        code = HUNG
    return Ended(code, told.decode(errors="replace"), time.monotonic() - started)


def _child(call: Callable[[], object], stderr: int) -> int:
    """What the forked process does; returns its exit code."""
    os.dup2(stderr, 2)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.stderr, sys.stdout = open(2, "w", closefd=False), open(1, "w", closefd=False)  # noqa: SIM115
    code: int = 0
    try:
        call()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    return code


def _read(pipe: int, until: float) -> tuple[bytes, bool]:
    """All that comes through ``pipe``, and whether its other end was closed before the time ``until``."""
    told = b""
    while True:
        ready, _, _ = select.select([pipe], [], [], max(0.0, until - time.monotonic()))
        if not ready:
            return told, False
        more = os.read(pipe, 65536)
        if not more:
            return told, True
        told += more


def complaint(ended: Ended, allowed: tuple[int, ...] = (0, 2)) -> str | None:
    """What is wrong with how a command ended: one that refuses says so in one line, without a traceback."""
    lines = [line for line in ended.told.splitlines() if line.strip()]
    if ended.code == HUNG:
        return f"hung for {ended.seconds:.0f} s"
    if "Traceback" in ended.told:
        return f"a traceback: {lines[-1][:160]}"
    if ended.code not in allowed:
        return f"exit {ended.code}: {' | '.join(lines)[-160:]}"
    if ended.code == 2 and not lines:
        return "exit 2 without a word of why"
    return None


def imported() -> Path:
    """Import what commands import, before any fork; returns the package's folder."""
    import importlib

    import torch

    # Threads survive no fork.
    torch.set_num_threads(1)
    for name in (
        "cli.commands",
        "envs",
        "evaluation",
        "evaluation.plots",
        "evaluation.sweep",
        "training.collect",
        "training.fit",
        "training.fit_spread",
        "training.policy",
        "training.train",
        "training.algorithms",
        "bench.replan",
        "tasks.trapper.data",
        "tasks.trapper.solvable",
        "tasks.trapper.policy",
        "tasks.trapper.causes",
        "tasks.fetch_reach.data",
        "tasks.fetch_reach.policy",
    ):
        module = importlib.import_module(f"torchdyn_plan.{name}")
    importlib.import_module("matplotlib.pyplot")
    return Path(module.__file__ or "").parent
