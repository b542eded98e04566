"""How far something is: a bar on a terminal; in a file or a pipe, a line at each tenth of the way."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any, Self


def progress_bar(
    iterable: Iterable[Any] | None = None,
    *,
    total: int | None = None,
    initial: int = 0,
    desc: str = "",
    unit: str = "it",
    leave: bool = True,
    disable: bool = False,
) -> Any:
    """What shows the way through ``iterable``, or of ``total`` things counted by ``update``; arguments are tqdm's."""
    shared: dict[str, Any] = {"total": total, "initial": initial, "desc": desc, "unit": unit, "disable": disable}
    if sys.stderr is not None and sys.stderr.isatty():
        from tqdm import tqdm

        return tqdm(iterable, leave=leave, **shared)
    return Lines(iterable, **shared)


class Lines:
    """Says on stderr how far something is, once at each tenth. One within another says nothing."""

    active = 0
    """How many are being gone through."""

    def __init__(
        self,
        iterable: Iterable[Any] | None = None,
        *,
        total: int | None = None,
        initial: int = 0,
        desc: str = "",
        unit: str = "it",
        disable: bool = False,
    ) -> None:
        """Begin; arguments are those of `progress_bar`."""
        self.iterable, self.desc, self.unit, self.disable = iterable, desc, unit, disable
        self.total = len(iterable) if total is None and hasattr(iterable, "__len__") else total  # pyright: ignore[reportArgumentType]
        self.n, self.told, self.note, self.started = initial, self._tenths(initial), "", time.monotonic()
        self.outermost = Lines.active == 0
        self.open = True
        Lines.active += 1

    def __iter__(self) -> Iterator[Any]:
        """Each item, and a line at each tenth of them."""
        with self:
            for item in self.iterable or ():
                yield item
                self.update()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """No more lines."""
        self.close()

    def update(self, more: int = 1) -> None:
        """Count ``more`` things."""
        self.n += more
        tenths = self._tenths(self.n)
        if tenths > self.told:
            self.told = tenths
            self._say(
                f"{self.desc}: {10 * tenths} % ({self.n} of {self.total} {self.unit}s, {self._passed()}{self.note})"
            )

    def set_postfix(self, figures: dict[str, Any]) -> None:
        """Tell ``figures`` with the next line."""
        self.note = "".join(f", {name} {value}" for name, value in figures.items())

    def set_postfix_str(self, text: str) -> None:
        """Tell ``text`` with the next line."""
        self.note = f", {text}"

    def reset(self, total: int) -> None:
        """Restart with ``total`` items."""
        self.n, self.told, self.total = 0, 0, total

    def close(self) -> None:
        """No more lines."""
        if self.open:
            self.open = False
            Lines.active -= 1

    def _tenths(self, count: int) -> int:
        return 10 * count // self.total if self.total else 0

    def _passed(self) -> str:
        minutes, seconds = divmod(round(time.monotonic() - self.started), 60)
        return f"{minutes}:{seconds:02d}"

    def _say(self, text: str) -> None:
        # Nobody may be reading any more: that is no reason to stop.
        if self.outermost and not self.disable and sys.stderr is not None:
            with contextlib.suppress(OSError, ValueError):
                sys.stderr.write(f"{text}\n")
                sys.stderr.flush()
