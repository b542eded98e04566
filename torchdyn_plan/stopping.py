"""Being told to stop: Ctrl-C and SIGTERM wait until what was done can be saved."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class Terminated(KeyboardInterrupt):
    """SIGTERM has told the process to end: it does as after Ctrl-C."""


@contextmanager
def terminable() -> Iterator[None]:
    """Within it SIGTERM raises `Terminated`, as Ctrl-C raises KeyboardInterrupt. Threads but the main one are left."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, former)


@contextmanager
def stop_when_safe() -> Iterator[Callable[[], bool]]:
    """Context in which the first Ctrl-C or SIGTERM is only recorded, and takes effect at the end.

    A second one takes effect at once. Signals for which Python has no handler of its own are left alone, and so are
    threads but the main one.
    """
    noted: list[int] = []
    former: dict[int, Any] = {}

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        if len(noted) > 1:
            former[number](number, frame)

    if threading.current_thread() is threading.main_thread():
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        former |= {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in former:
        signal.signal(number, note)
    try:
        yield lambda: bool(noted)
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
    if noted:
        former[noted[0]](noted[0], None)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated
