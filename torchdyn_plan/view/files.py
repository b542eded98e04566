"""Films and strips of pictures; the file extension decides the format."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError
from torchdyn_plan.files import write_whole
from torchdyn_plan.view.pictures import GAP, Film

MOVING = (".mp4", ".gif", ".webp")
STILL = ".png"
ENDINGS = (*MOVING, STILL)
"""File extensions: films, and a strip of single pictures."""
COLUMNS = 4
"""Most pictures in a row of a strip, for one recording."""


def write_film(
    film: Film,
    out: Path,
    *,
    fps: float = 25.0,
    speed: float = 0.5,
    hold: float = 1.0,
    strip: int = 8,
    quality: int = 60,
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> None:
    """Write ``film`` to ``out``, atomically.

    Args:
        film: what is drawn.
        out: ``.mp4``, ``.gif`` or ``.webp`` for a film, ``.png`` for a strip.
        fps: frames a second of a film; approximate for a GIF, which counts in hundredths of a second.
        speed: seconds of the episode per second of a film.
        hold: time for which the last picture stays [s].
        strip: number of pictures in a strip, equally spaced in time.
        quality: of a WebP, 0 to 100.
        progress: wraps the iteration over the control steps drawn, to show progress.

    Raises:
        InputError: the extension is another one, a number is out of range, this machine cannot render, or
            imageio-ffmpeg, which writes MP4, is missing.
        OutputError: the file cannot be written.
    """
    check_film(out, strip=strip, quality=quality)
    ending = out.suffix.lower()
    if ending == STILL:
        steps = np.linspace(0, film.length, strip).round().astype(int).tolist()
        image = Image.fromarray(tiled(list(film.pictures(progress(steps)))))
        write_whole(out, image.save)
        return
    pictures = film.pictures(progress(film.steps(fps=fps, speed=speed, hold=hold)))
    if ending == ".mp4":
        writer = mp4_writer()
        write_whole(out, lambda place: write_mp4(writer, place, pictures, fps))
        return
    images = [Image.fromarray(picture) for picture in pictures]
    how: dict[str, Any] = {"quality": quality, "method": 6} if ending == ".webp" else {"optimize": True}
    first, *others = images if ending == ".webp" else with_one_palette(images)
    times = {"duration": round(1000.0 / fps), "loop": 0, "save_all": True, "append_images": others}
    write_whole(out, lambda place: first.save(place, **times, **how))


def check_film(out: Path, *, strip: int = 8, quality: int = 60) -> None:
    """Raise `InputError` for a file or a number that `write_film` would refuse, before an episode is played."""
    if out.suffix.lower() not in ENDINGS:
        raise InputError(f"out must end in one of {', '.join(ENDINGS)}, got {out.name!r}")
    check_number("strip", strip, minimum=1, maximum=100, integer=True)
    check_number("quality", quality, minimum=0, maximum=100, integer=True)
    if out.suffix.lower() == ".mp4":
        mp4_writer()


def tiled(pictures: list[np.ndarray[Any, Any]]) -> np.ndarray[Any, Any]:
    """``pictures`` of one size in a grid, from left to right and top to bottom, on white."""
    height, width, _ = pictures[0].shape
    columns = min(len(pictures), COLUMNS)
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, dtype=np.uint8)
    for number, picture in enumerate(pictures):
        top, left = (number // columns) * (height + GAP), (number % columns) * (width + GAP)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def with_one_palette(images: list[Image.Image]) -> list[Image.Image]:
    """``images`` with the palette of the middle one: a GIF with changing palettes flickers."""
    palette = images[len(images) // 2].quantize(256)
    return [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]


def mp4_writer() -> Any:
    """The module that writes MP4; raises `InputError` if it is not installed."""
    try:
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            "an MP4 needs imageio-ffmpeg (extra view): pip install imageio-ffmpeg, or choose .webp or .gif"
        ) from error
    return imageio_ffmpeg


def write_mp4(writer: Any, out: Path, pictures: Iterable[np.ndarray[Any, Any]], fps: float) -> None:
    """Write ``pictures`` to ``out`` as H.264, cropped to even sizes."""
    sink = None
    for picture in pictures:
        even = np.ascontiguousarray(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2])
        if sink is None:
            size = even.shape[1], even.shape[0]
            sink = writer.write_frames(str(out), size, fps=fps, macro_block_size=2, quality=7)
            sink.send(None)
        sink.send(even)
    if sink is not None:
        sink.close()
