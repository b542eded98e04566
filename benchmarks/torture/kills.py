"""Commands killed with SIGKILL at random moments and started again."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

from benchmarks.torture import forked
from benchmarks.torture.commands_in_small import COMMANDS, differing, ends, prepare, start, whole, words_of
from benchmarks.torture.promise import Cases, Promise

KILLS = 10
"""Times that each command is killed."""
ONCE = {".safetensors": ("paths-", "arrivals-"), ".json": ("velocity-",)}
"""Files that are written once: results that no later run may touch, by ending and beginning of their names."""


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Each command, left alone once and killed `KILLS` times: a case a kill, and one for how it ends."""
    prepare(folder / "data")
    names = list(COMMANDS)[: max(1, count // (KILLS + 1))]
    for name in names:
        yield from _kill(draw, folder, name)


def _kill(draw: Random, folder: Path, name: str) -> Cases:
    alone, killed = folder / "alone" / name, folder / "killed" / name
    calm = forked.run(lambda: start(words_of(name, alone, folder / "data")), at_most=300.0)
    if calm.code:
        yield f"{name}: failed when left alone: {calm.told[-300:]}"
        return
    for _ in range(KILLS):
        saved = _results(killed)
        moment = draw.uniform(0.0, 1.05 * calm.seconds)
        ended = forked.run(lambda: start(words_of(name, killed, folder / "data")), kill_after=moment)
        lost = [place for place, content in saved.items() if not place.is_file() or place.read_bytes() != content]
        fault = whole(killed) or (f"{lost[0].name} was lost or written anew" if lost else None)
        # One that had ended by itself in time has done its work.
        fault = fault or (forked.complaint(ended) if ended.code >= 0 else None)
        yield None if fault is None else f"{name}, killed after {moment:.2f} s: {fault}"
    last = forked.run(lambda: start(words_of(name, killed, folder / "data")), at_most=300.0)
    fault = forked.complaint(last, (0,))
    other = differing(ends(alone), ends(killed))
    fault = fault or (f"ends differ: {', '.join(other)}" if other else None)
    left = [place.name for place in killed.rglob(".torchdyn_plan-*")]
    fault = fault or (f"left behind: {', '.join(left)}" if left else None)
    yield None if fault is None else f"{name}, killed {KILLS} times: {fault}"


def _results(out: Path) -> dict[Path, Any]:
    """What has been saved once and for all."""
    files = [file for file in out.rglob("*") if file.name.startswith(ONCE.get(file.suffix, ("//",)))]
    return {file: file.read_bytes() for file in files if not any(part.startswith(".torchdyn") for part in file.parts)}


PROMISE = Promise(
    says="a command that is killed at any moment loses nothing saved, and ends as if it had been left alone",
    cases=cases,
    count=(KILLS + 1) * len(COMMANDS),
)
