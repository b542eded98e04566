"""Pictures of recordings side by side, each with a line of text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.painter import LARGEST, Painter
from torchdyn_plan.errors import InputError
from torchdyn_plan.view.marks import LAYERS, marks_at
from torchdyn_plan.view.recording import Recording
from torchdyn_plan.view.words import caption

PAPER, INK, FAINT, GOOD, BAD = (250, 250, 248), (25, 25, 25), (95, 95, 95), (0, 105, 80), (180, 50, 0)
GAP = 4
"""Between two pictures [pixels]."""
LARGEST_FPS = 60
"""Highest frame rate of a film [Hz]."""


class Film:
    """Draws recordings of one episode side by side; a recording that has ended shows its last step."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        *,
        width: int = 400,
        height: int = 300,
        layers: Sequence[str] = LAYERS,
    ) -> None:
        """Draw ``recordings``, each ``width`` by ``height`` pixels and its text; of the marks only ``layers``.

        Raises:
            InputError: there is no recording, a size is not a whole number of pixels, or the recordings do not match.
        """
        if not recordings:
            raise InputError("a film needs at least one recording, got none")
        for name, size in (("width", width), ("height", height)):
            check_number(name, size, minimum=64, maximum=LARGEST, integer=True)
        self.recordings, self.width, self.height, self.layers = recordings, width, height, layers
        self.bar = max(16, round(0.09 * height))
        self._painters = [Painter(recording.look) for recording in recordings]
        self._drawn: dict[int, tuple[int, Image.Image]] = {}

    @property
    def length(self) -> int:
        """Control steps of the longest recording."""
        return max(recording.length for recording in self.recordings)

    def picture(self, step: int) -> np.ndarray[Any, Any]:
        """All recordings at ``step``, ``(height + text, total width, 3)`` uint8; raises like `Painter.picture`."""
        count = len(self.recordings)
        image = Image.new("RGB", (count * self.width + (count - 1) * GAP, self.height + 2 * self.bar), PAPER)
        for number, recording in enumerate(self.recordings):
            left, now = number * (self.width + GAP), min(step, recording.length)
            image.paste(self._draw(number, now), (left, self.bar))
            self._write(image, recording, left, now)
        return np.asarray(image)

    def _draw(self, number: int, step: int) -> Image.Image:
        """The world of recording ``number``; drawn again only if it has moved."""
        before, drawn = self._drawn.get(number, (None, None))
        if drawn is None or before != step:
            recording, painter = self.recordings[number], self._painters[number]
            marks = [marks for name, marks in marks_at(recording, step).items() if name in self.layers]
            drawn = Image.fromarray(painter.picture(recording.posture[step], self.width, self.height, marks))
            self._drawn[number] = step, drawn
        return drawn

    def _write(self, image: Image.Image, recording: Recording, left: int, step: int) -> None:
        draw, middle = ImageDraw.Draw(image), left + self.width / 2
        ended = step >= recording.length
        colour = FAINT if not ended else GOOD if recording.success else BAD
        name, size = recording.scenario.planner.replace("_", " "), round(0.6 * self.bar)
        draw.text((middle, self.bar / 2), name, INK, font(size), anchor="mm")
        below = self.bar * 1.5 + self.height
        draw.text((middle, below), caption(recording, step), colour, font(round(0.9 * size)), anchor="mm")

    def steps(self, *, fps: float, speed: float, hold: float = 0.0) -> list[int]:
        """Control steps of a film's frames.

        Args:
            fps: frames a second.
            speed: seconds of the episode per second of the film.
            hold: time for which the last picture stays [s].

        Raises:
            InputError: a number is out of range.
        """
        check_number("fps", fps, minimum=1, maximum=LARGEST_FPS)
        check_number("speed", speed, minimum=0.01, maximum=100.0)
        check_number("hold", hold, minimum=0.0, maximum=60.0)
        each = speed / (fps * self.recordings[0].scenario.task.control_step)
        moving = np.unique(np.append(np.arange(0.0, self.length, each).round(), self.length)).astype(int)
        return [*moving.tolist(), *[self.length] * round(hold * fps)]

    def pictures(self, steps: Iterable[int]) -> Iterator[np.ndarray[Any, Any]]:
        """The pictures of ``steps`` in order; repeated steps are drawn once."""
        before, drawn = None, np.zeros(0)
        for step in steps:
            if step != before:
                before, drawn = step, self.picture(step)
            yield drawn


@cache
def font(size: int) -> Any:
    """A font of ``size`` pixels."""
    return ImageFont.load_default(size)
