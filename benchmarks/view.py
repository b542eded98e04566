"""The page in the browser: its update rate with a client, and the cost of a step.

python benchmarks/view.py --out benchmarks/results/view.json

A client that receives everything, like a browser, is connected while the page plays; the page sends at most 40 steps a
second. ``ms_per_step`` is the processor time, over all threads, of a step without a client.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any

import tyro
import viser
from study import Output, Row, Study, each
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from torchdyn_plan.tasks import load_task
from torchdyn_plan.view import Page, Scenario
from torchdyn_plan.view.page import HOST

PATIENCE = 300.0
"""An episode is recorded within this time [s]."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Serve the page, and watch it."""

    shown: tuple[str, ...] = (
        "trapper:wait_and_drop",
        "trapper:wait_and_drop,corner",
        "chase:meet",
        "fetch_reach:exact",
    )
    """What is shown: a task, and one planner of it or two, as TASK:PLANNER,PLANNER."""
    episode: int = 2
    """Number of the episode."""
    seconds: float = 10.0
    """For which each is watched [s]."""
    port: int = 8380
    """Of the page, or the next free one."""


@dataclass
class Watcher:
    """A client that takes in whatever it is sent, in a thread of its own."""

    port: int
    received: int = 0
    """Bytes."""
    ready: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.thread = threading.Thread(target=self._watch, daemon=True)
        self.thread.start()

    def _watch(self) -> None:
        protocol: Any = f"viser-v{viser.__version__}"
        with connect(f"ws://{HOST}:{self.port}", subprotocols=[protocol], max_size=None) as socket:
            self.ready.set()
            try:
                for message in socket:
                    self.received += len(message)
            except ConnectionClosed:
                return


def measured(shown: str, arguments: Arguments) -> Row:
    """Steps that are sent a second, their size, and what one costs."""
    name, _, planners = shown.partition(":")
    task = load_task(name)
    scenarios = [Scenario(task=task, planner=one, episode=arguments.episode) for one in planners.split(",")]
    page = Page(scenarios, port=arguments.port)
    try:
        begun = time.monotonic()
        while page.length == 0:
            if time.monotonic() - begun > PATIENCE:
                raise SystemExit(f"{shown} was not recorded: {page.controls.says}")
            time.sleep(0.01)
        page.controls.pause()
        row = {"ms_per_step": cost(page)}
        watcher = Watcher(page.server.get_port())
        watcher.ready.wait(PATIENCE)
        # The page has to play as long as it is watched.
        page.controls.speed = 0.9 * page.length * task.control_step / arguments.seconds
        page.go_to(0)
        # The world itself is sent first.
        time.sleep(2.0)
        page.controls.play()
        before, bytes_before, begun = page.pushed, watcher.received, time.monotonic()
        time.sleep(arguments.seconds)
        sent, seconds = page.pushed - before, time.monotonic() - begun
        row |= {"steps_per_second": sent / seconds, "kb_per_step": (watcher.received - bytes_before) / 1024 / sent}
        return row
    finally:
        page.close()


def cost(page: Page, count: int = 100) -> float:
    """Processor time of a step of the page that nobody watches [ms]."""
    begun = time.process_time()
    for number in range(count):
        page.go_to(number * page.length / count)
    return 1e3 * (time.process_time() - begun) / count


def main(arguments: Arguments) -> None:
    """Measure, save and print."""
    study = Study(arguments, resume=False)
    for shown in each(arguments.shown, "pages"):
        about = {"shown": shown, "episode": arguments.episode, "viser": viser.__version__}
        study.row(about, lambda one=shown: measured(one, arguments))


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
