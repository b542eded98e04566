"""Comparison of two checkouts of this package: each runs in its own process, on one thread."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from study import Output, Row, measuring

HERE = Path(__file__).parent


@dataclass(frozen=True, kw_only=True)
class Compared(Output):
    """Arguments of a study of two checkouts."""

    repeats: int = 3
    """Times that each is asked, in turn; the CPU time is the least."""
    former: Path | None = None
    """Folder of another checkout, which is asked the same."""
    side: bool = False
    """Serve as one side: lines come in, a line of JSON for each goes out."""


class Side:
    """A process that runs a script of this folder with one checkout's package."""

    def __init__(self, script: str, checkout: Path, *words: str) -> None:
        """Start it, as one side, with more ``words`` of arguments."""
        env = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, str(HERE / script), "--side", *words]
        self.process = subprocess.Popen(command, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, line: str) -> Row:
        """What it answers."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def end(self) -> None:
        """Stop it."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def serve(answer: Callable[[str], Row]) -> None:
    """Answer what standard input asks for."""
    with measuring():
        for line in sys.stdin:
            print(json.dumps(answer(line.strip())), flush=True)


def started(script: str, former: Path | None, *words: str) -> dict[str, Side]:
    """The sides: this checkout, and the former one where there is one."""
    checkouts = {"now": HERE.parent} | ({} if former is None else {"former": former})
    return {key: Side(script, checkout, *words) for key, checkout in checkouts.items()}


def in_turn(sides: dict[str, Side], line: str, repeats: int) -> dict[str, Row]:
    """The answer of each side, with the least of its ``seconds``."""
    rows: dict[str, list[Row]] = {key: [] for key in sides}
    for _ in range(repeats):
        for key, side in sides.items():
            rows[key].append(side.ask(line))
    return {key: {**found[0], "seconds": min(row["seconds"] for row in found)} for key, found in rows.items()}
