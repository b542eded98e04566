"""The Robot Air Hockey Challenge: our planner beside the organisers' baseline agent, on the same starts.

python benchmarks/air_hockey.py --python /tmp/hockey/bin/python --repository /tmp/air_hockey_challenge \
    --out benchmarks/results/air_hockey.json

The challenge runs in an environment of its own (docs/air-hockey.md), and answers over a pipe. Ours are
`DynamicPlanner`s of the package's parts; what knows of mallets and pucks is in `air_hockey_defend.py` and
`air_hockey_hit.py`. Rows are blocks of episodes; a killed study goes on.
"""

from __future__ import annotations

import base64
import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from air_hockey_agent import Agent
from air_hockey_defend import Defender
from air_hockey_hit import Hitter
from sides import Answering
from study import Output, Row, Study, each, measuring, rate_entries, told

LIMIT = 20.0
"""An action may take so long [ms]."""
SIZE = 360, 270
"""Of a picture [pixels]."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Play the same starts with each agent."""

    python: Path
    """Interpreter of the challenge's environment."""
    repository: Path | None = None
    """Folder of the organisers' repository, for the baseline."""
    tasks: tuple[str, ...] = ("3dof-defend", "7dof-defend", "3dof-hit", "7dof-hit")
    """The challenge's tasks."""
    agents: tuple[str, ...] = ("ours", "baseline")
    """Who plays."""
    episodes: int = 200
    """Starts, a multiple of the block."""
    block: int = 10
    """Of them in a row."""
    series: str = "test"
    """Of the starts: test, or dev while tuning."""
    picture: Path | None = None
    """WebP of our first episodes, drawn in place of a measurement; the challenge's machine needs OpenGL."""


class Challenge(Answering):
    """One of the challenge's tasks, in a process of its own, ready for calls of its `Side`."""

    def __init__(self, task: str, arguments: Arguments) -> None:
        """Start it."""
        more = [] if arguments.repository is None else [str(arguments.repository.resolve())]
        super().__init__(arguments.python, "air_hockey_side.py", task, *more, package=None)
        self.about = self.answer()


def agent_of(task: str, challenge: Challenge) -> Agent:
    """Ours for a task."""
    return (Hitter if task.endswith("-hit") else Defender)(challenge.about)


@contextmanager
def undisturbed() -> Iterator[None]:
    """No garbage is collected meanwhile, but before: to look through all that torch has loaded takes too long."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def play(
    challenge: Challenge,
    agent: Agent,
    series: str,
    episode: int,
    *,
    each_step: Callable[[int], None] = lambda step: None,
) -> Row:
    """One episode of ours, as `Side.baseline` tells of the baseline's; ``each_step`` is called before each."""
    seen = challenge.call("reset", series, episode)
    agent.start()
    milliseconds: list[list[float]] = []
    violated: set[str] = set()
    with undisturbed():
        while True:
            each_step(len(milliseconds))
            begun = time.perf_counter(), time.process_time()
            action = agent.act(seen)
            taken = time.perf_counter() - begun[0], time.process_time() - begun[1]
            milliseconds.append([1e3 * seconds for seconds in taken])
            seen = challenge.call("step", *action)
            violated.update(seen["violated"])
            if seen["over"]:
                return {"success": seen["success"], "violated": sorted(violated), "milliseconds": milliseconds}


def draw(challenge: Challenge, agent: Agent, arguments: Arguments, *, episodes: int = 3, every: int = 2) -> None:
    """Write a moving picture of some episodes, one after the other."""
    from PIL import Image

    assert arguments.picture is not None
    frames: list[Image.Image] = []

    def frame() -> None:
        picture = base64.b64decode(challenge.call("picture", *SIZE))
        frames.append(Image.frombytes("RGB", SIZE, picture))

    for episode in range(episodes):
        play(challenge, agent, arguments.series, episode, each_step=lambda step: frame() if step % every == 0 else None)
        frames.extend([frames[-1]] * 15)
    pause = int(1000 * every * challenge.about["control_step"])
    frames[0].save(
        arguments.picture, save_all=True, append_images=frames[1:], duration=pause, loop=0, quality=60, method=6
    )


def measure(challenge: Challenge, agent: Agent | None, series: str, first: int, count: int) -> Row:
    """A block of episodes: which are lost, what is violated in each, and its actions' times; None for the baseline."""
    played = []
    for episode in range(first, first + count):
        if agent is None:
            played.append(challenge.call("baseline", series, episode))
        else:
            played.append(play(challenge, agent, series, episode))
    times = np.concatenate([row["milliseconds"] for row in played])
    return {
        "lost": [first + number for number, row in enumerate(played) if not row["success"]],
        "violated": [row["violated"] for row in played if row["violated"]],
        "actions": len(times),
        **timing("ms", times[:, 0]),
        **timing("processor_ms", times[:, 1]),
    }


def timing(name: str, milliseconds: np.ndarray[Any, Any]) -> Row:
    """Mean and greatest of times (A,) of actions, and how many took too long."""
    high = {"mean": milliseconds.mean(), "max": milliseconds.max()}
    late = {f"{name}_late": int((milliseconds > LIMIT).sum())}
    return {f"{name}_{what}": float(value) for what, value in high.items()} | late


def summary(rows: Sequence[Row]) -> Row:
    """Figures of all blocks of an agent in a task."""
    episodes, actions = sum(row["block"] for row in rows), sum(row["actions"] for row in rows)
    violated = [names for row in rows for names in row["violated"]]
    found = {
        "episodes": episodes,
        **rate_entries("success", episodes - sum(len(row["lost"]) for row in rows), episodes),
        "episodes_with_violations": len(violated),
        "violations": {name: sum(name in names for names in violated) for name in sorted(set().union(*violated))},
    }
    for name in ("ms", "processor_ms"):
        found[f"{name}_mean"] = sum(row[f"{name}_mean"] * row["actions"] for row in rows) / actions
        found[f"{name}_max"] = max(row[f"{name}_max"] for row in rows)
        found[f"{name}_late"] = sum(row[f"{name}_late"] for row in rows) / actions
    return found


def main(arguments: Arguments) -> None:
    """Play, save and print."""
    if arguments.picture is not None:
        challenge = Challenge(arguments.tasks[0], arguments)
        with measuring():
            draw(challenge, agent_of(arguments.tasks[0], challenge), arguments)
        challenge.close()
        return
    study = Study(arguments)
    challenges = {task: Challenge(task, arguments) for task in arguments.tasks}
    ours = {task: agent_of(task, challenge) for task, challenge in challenges.items()}
    pairs = [(task, agent) for task in arguments.tasks for agent in arguments.agents]
    with measuring():
        for first in each(range(0, arguments.episodes, arguments.block), "blocks"):
            for task, agent in pairs:
                about = {"task": task, "agent": agent, "series": arguments.series}
                about |= {"first": first, "block": arguments.block}
                player = ours[task] if agent == "ours" else None
                given = challenges[task], player, arguments.series, first, arguments.block
                study.row(about, partial(measure, *given))
    found = []
    for task, agent in pairs:
        own = {"task": task, "agent": agent, "series": arguments.series}
        found.append(own | summary([row for row in study.rows if own.items() <= row.items()]))
        print(told(found[-1]))
    study.save(summary=found)
    for challenge in challenges.values():
        challenge.close()


if __name__ == "__main__":
    main(tyro.cli(Arguments))
