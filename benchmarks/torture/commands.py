"""Arguments of commands that nobody means."""

from __future__ import annotations

import os
from pathlib import Path
from random import Random

from benchmarks.torture import forked
from benchmarks.torture.commands_in_small import prepare, start
from benchmarks.torture.promise import Cases, Promise

BASES = {
    "evaluate": "evaluate --planners pursuit --episodes 1 --num-envs 1 --threads 1 --out OUT",
    "evaluate reach": "evaluate --task fetch_reach --planners pursuit --episodes 1 --num-envs 1 --threads 1 --out OUT",
    "sweep": "sweep --over velocity --values 1 --planners pursuit --episodes 1 --repeats 1 --threads 1 --out OUT",
    "collect paths": "collect paths --episodes 2 --num-envs 2 --threads 1 --out OUT",
    "collect arrivals": "collect arrivals --episodes 1 --num-envs 2 --threads 1 --out OUT",
    "train eta": "train eta --steps 1 --batch 4 --data DATA/trapper --out OUT",
    "train forecaster": "train forecaster --task fetch_reach --steps 1 --batch 4 --data DATA/fetch_reach --out OUT",
    "train policy": "train policy --task fetch_reach --steps 1 --num-envs 2 --batch 4 --threads 1 --out OUT",
    "bench replan": "bench replan --planner pursuit --batches 1 --seconds 0 --threads 1 --out OUT/x.json",
}
"""Commands that are fine, and short."""
OPTIONS = (
    *("--task", "--planners", "--static", "--weights", "--episodes", "--seed", "--split", "--num-envs", "--threads"),
    *("--latency-ms", "--over", "--values", "--repeats", "--steps", "--batch", "--lr", "--device", "--data", "--out"),
    *("--velocity", "--friction", "--algorithm", "--workers", "--batches", "--seconds", "--planner", "--period"),
    *("--threshold", "--motion", "--nonsense", "-x"),
)
VALUES = (
    *("", " ", "0", "-1", "1.5", "nan", "inf", "-inf", "1e400", "1" * 30, "-" + "9" * 30, "1e9", "True", "{}"),
    *("x" * 400, "../..", "/dev/null", "/dev/null/x", "/proc/1/x", "~", "-", "--", "meta", "cuda:99", "cpu:0", "mps"),
    *("ünïcödé", "a\nb", "a:b", "torchdyn_plan.errors:InputError", "os:system", "nowhere:NAME", "[1,2]", "1,2", "*"),
    *("trapper", "fetch_reach", "corner", "oracle", "ik", "rl", "dher", "dev", "test", "velocity", "averaged"),
)
LONGEST = 60.0
"""A short command that takes longer hangs [s]."""


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Short commands with some words changed, each in a process of its own, in an empty folder."""
    prepare(folder / "data")
    for number in range(count):
        name = draw.choice(list(BASES))
        place = folder / "run" / str(number)
        place.mkdir(parents=True)
        words = _changed(draw, BASES[name].split())
        fit = [word.replace("OUT", str(place / "out")).replace("DATA", str(folder / "data")) for word in words]
        ended = forked.run(lambda place=place, fit=fit: _in(place, fit), at_most=LONGEST)
        # Left without values, a sweep takes its own: it is at work, and does not hang.
        works = ended.code == forked.HUNG and " %" in ended.told
        fault = None if works else forked.complaint(ended) or _left(place, ended)
        yield None if fault is None else f"{' '.join(map(repr, words))}: {fault}"


def _in(place: Path, words: list[str]) -> None:
    os.chdir(place)
    start(words)


def _changed(draw: Random, words: list[str]) -> list[str]:
    """``words`` after a mistake or two."""
    for _ in range(draw.choice((1, 1, 2))):
        kind = draw.randrange(6)
        options = [place for place, word in enumerate(words[:-1]) if word.startswith("--")]
        if kind <= 2 and options:
            words[draw.choice(options) + 1] = draw.choice(VALUES)
        elif kind == 3:
            words = [*words, draw.choice(OPTIONS), draw.choice(VALUES)]
        elif kind == 4:
            words = [word for place, word in enumerate(words) if place != (hit := draw.randrange(len(words)))] or [
                str(hit)
            ]
        else:
            words.insert(draw.randrange(len(words) + 1), draw.choice((*VALUES, *OPTIONS)))
    return words


def _left(place: Path, ended: forked.Ended) -> str | None:
    """An empty folder that a refused command leaves, or what any command leaves of its own work."""
    left = [one for one in place.rglob("*") if one.name.startswith(".torchdyn_plan-")]
    if ended.code == 2:
        left += [one for one in place.rglob("*") if one.is_dir() and not any(one.iterdir())]
    return f"it leaves {left[0].relative_to(place)}" if left else None


PROMISE = Promise(
    says="a command with any words ends, with exit 0, or 2 and one line of why, and leaves no empty folders",
    cases=cases,
    count=600,
)
