"""Comparison of two checkouts of this package: each runs in its own process, on one thread."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


class Answering:
    """A process, on one thread, that answers each line it reads with a line of JSON."""

    def __init__(self, python: Path | str, script: str, *words: str, package: Path | None) -> None:
        """Start ``script`` of this folder with this ``python`` and the package in that folder, or none."""
        env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}
        if package is not None:
            env["PYTHONPATH"] = str(package)
        self.script, command = script, [str(python), str(HERE / script), *words]
        self.process = subprocess.Popen(command, env=env, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def ask(self, line: str) -> Any:
        """What it answers to ``line``."""
        assert self.process.stdin
        print(line, file=self.process.stdin, flush=True)
        return self.answer()

    def call(self, name: str, *arguments: Any) -> Any:
        """What it answers to the name of a method and its arguments."""
        return self.ask(json.dumps([name, arguments]))

    def answer(self) -> Any:
        """What it says next."""
        assert self.process.stdout
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"{self.script} ended in its process; what it said stands above")
        return json.loads(line)

    def close(self) -> None:
        """Let it end."""
        assert self.process.stdin
        self.process.stdin.close()
        self.process.wait()


class Side(Answering):
    """A process that runs a script of this folder with one checkout's package."""

    def __init__(self, script: str, checkout: Path, *words: str) -> None:
        """Start it, as one side, with more ``words`` of arguments."""
        super().__init__(sys.executable, script, "--side", *words, package=checkout)


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
