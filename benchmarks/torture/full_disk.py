"""A disk that is full, at each write of each command and for files of every size."""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Callable
from pathlib import Path
from random import Random

from benchmarks.torture import forked
from benchmarks.torture.commands_in_small import COMMANDS, differing, ends, prepare, start, whole, words_of
from benchmarks.torture.promise import Cases, Promise

SIZES = (0, 100, 600, 5_000, 60_000)
"""Sizes at which files end, as with a quota [bytes]."""
MARK = "#written#"
"""Told on stderr at each write."""


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """For each command a disk that is full at its 1st, 2nd, … write, and files that end at each of `SIZES`."""
    prepare(folder / "data")
    for name in list(COMMANDS)[: max(1, count // 15)]:
        yield from _fill(folder, name)


def _fill(folder: Path, name: str) -> Cases:
    alone = folder / "alone" / name
    calm = _run(folder, name, alone, lambda: _full_at(0))
    if calm.code:
        yield f"{name}: failed with room on the disk: {calm.told[-300:]}"
        return
    faults: list[tuple[str, Callable[[], object]]] = [
        (f"full at write {number}", lambda number=number: _full_at(number))
        for number in range(1, calm.told.count(MARK) + 1)
    ]
    faults += [(f"files end at {size} bytes", lambda size=size: _files_end_at(size)) for size in SIZES]
    for number, (what, spoil) in enumerate(faults):
        out = folder / "full" / name / str(number)
        ended = _run(folder, name, out, spoil)
        fault = forked.complaint(ended) or whole(out)
        # Shared memory of another library is a file too, to which a quota applies: the system's own words tell it.
        says = ("cannot", "not writable", "File too large")
        if ended.code == 2 and fault is None and not any(words in ended.told for words in says):
            fault = f"the error does not say that a file cannot be written: {ended.told[-200:]}"
        if fault is None:
            again = _run(folder, name, out, lambda: None)
            other = differing(ends(alone), ends(out))
            fault = forked.complaint(again, (0,)) or (f"afterwards ends differ: {', '.join(other)}" if other else None)
        yield None if fault is None else f"{name}, {what}: {fault}"


def _run(folder: Path, name: str, out: Path, spoil: Callable[[], object]) -> forked.Ended:
    words = words_of(name, out, folder / "data")
    if "--steps" in words:
        words[words.index("--steps") + 1] = "2"
    return forked.run(lambda: start(words, spoil), at_most=300.0)


def _full_at(number: int) -> None:
    """Let the write ``number`` find no room, and none after it; all have room for 0."""
    written, whole_file = 0, os.fsync

    def fsync(file: int) -> None:
        nonlocal written
        written += 1
        if number and written >= number:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        whole_file(file)
        os.write(2, f"{MARK}\n".encode())

    os.fsync = fsync


def _files_end_at(size: int) -> None:
    """Let the system refuse what would make a file larger than ``size`` bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


PROMISE = Promise(
    says="on a full disk saved results stay, one line says what cannot be written, and the command goes on later",
    cases=cases,
    count=15 * len(COMMANDS),
)
