"""Closed pipes, terminals that know few letters, streams that are full or closed, and signals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from random import Random
from typing import IO

from benchmarks.torture.promise import Cases, Promise

WORDS = {
    "evaluate": "evaluate --planners pursuit --episodes 2 --num-envs 2 --threads 1 --out",
    "sweep": "sweep --over velocity --values 1 --planners pursuit --episodes 2 --repeats 2 --threads 1 --out",
}
LETTERS = ("ascii", "latin-1", "cp437", "utf-16", "ascii:strict")


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Whole processes of each command, as a shell starts them."""
    for name, words in WORDS.items():
        for number, letters in enumerate(LETTERS):
            out = folder / name / str(number)
            done = _run([*words.split(), str(out)], letters=letters)
            yield _judge(name, f"letters of {letters}", done.returncode, done.stderr, out)
        for what in ("closed pipe", "full device", "no stdout", "no stderr", "stderr closed too"):
            out = folder / name / what
            code, told = _with_streams([*words.split(), str(out)], what)
            # What was asked for cannot be printed: that may be an error, but never a loss.
            yield _judge(name, what, 0 if code == 2 and what in ("full device", "no stdout") else code, told, out)
    for number in range(max(1, count - 20)):
        out = folder / "signals" / str(number)
        yield _stop(draw, [*WORDS["sweep"].split(), str(out)], draw.choice((signal.SIGTERM, signal.SIGINT)))


def _command(words: list[str]) -> list[str]:
    return [sys.executable, "-m", "torchdyn_plan", *words]


def _run(words: list[str], *, letters: str) -> subprocess.CompletedProcess[bytes]:
    env = os.environ | {"PYTHONIOENCODING": letters}
    return subprocess.run(_command(words), env=env, capture_output=True, check=False, timeout=200)


def _with_streams(words: list[str], what: str) -> tuple[int, bytes]:
    reading, writing = os.pipe()
    os.close(reading)
    streams: dict[str, int | IO[bytes]] = {"stdout": writing, "stderr": subprocess.PIPE}
    shell = {"no stdout": 'exec "$@" >&-', "no stderr": 'exec "$@" 2>&-', "stderr closed too": 'exec "$@" >&- 2>&-'}
    command = _command(words)
    if what in shell:
        streams["stdout"] = subprocess.PIPE
        command = ["sh", "-c", shell[what], "sh", *command]
    full = Path("/dev/full").open("wb") if what == "full device" else None  # noqa: SIM115
    if full is not None:
        streams["stdout"] = full
    done = subprocess.run(command, **streams, check=False, timeout=200)  # pyright: ignore[reportCallIssue, reportArgumentType]
    os.close(writing)
    if full is not None:
        full.close()
    return done.returncode, done.stderr or b""


def _judge(name: str, what: str, code: int, told: bytes, out: Path) -> str | None:
    text = told.decode(errors="replace")
    if b"Traceback" in told or b"Exception ignored" in told:
        return f"{name}, {what}: {text.splitlines()[-1][:200]}"
    if code != 0:
        return f"{name}, {what}: exit {code}: {text[-200:]}"
    if b"\r" in told:
        return f"{name}, {what}: a carriage return in a file"
    try:
        rows = json.loads((out / "results.json").read_text())["rows"]
    except (OSError, ValueError) as error:
        return f"{name}, {what}: the results are lost: {error}"
    return None if rows else f"{name}, {what}: no rows"


def _stop(draw: Random, words: list[str], number: signal.Signals) -> str | None:
    """Ended by ``number`` at a random moment: one line and its code, no traceback; afterwards it goes on."""
    process = subprocess.Popen(_command(words), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    time.sleep(draw.uniform(2.0, 6.0))
    process.send_signal(number)
    told = process.communicate(timeout=200)[1]
    codes = {signal.SIGTERM: (0, 143, -15), signal.SIGINT: (0, 130, -2)}
    # Before the package is there, Python itself ends as it does.
    if process.returncode not in codes[number] or (b"Traceback" in told and b"torchdyn_plan/cli" in told):
        return f"{number.name}: exit {process.returncode}: {told.decode(errors='replace')[-300:]}"
    again = _run(words, letters="utf-8")
    return _judge("sweep", f"after {number.name}", again.returncode, again.stderr, Path(words[-1]))


PROMISE = Promise(
    says="results are saved before anything is printed, whoever reads; signals end a command in one line",
    cases=cases,
    count=28,
)
