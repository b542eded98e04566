"""Watching an episode: a recording of it step by step, drawn on a page in the browser or into a file.

Everything named here is imported when it is first used.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchdyn_plan.errors import InputError

if TYPE_CHECKING:
    from torchdyn_plan.view.files import check_film, write_film
    from torchdyn_plan.view.page import Page, serve
    from torchdyn_plan.view.pictures import Film
    from torchdyn_plan.view.recording import Recording, Scenario, record_episode

_PLACES = {
    "Film": "pictures",
    "Page": "page",
    "Recording": "recording",
    "Scenario": "recording",
    "check_film": "files",
    "record_episode": "recording",
    "serve": "page",
    "write_film": "files",
}
"""Module of this folder that defines each name."""

__all__ = [
    "Film",
    "Page",
    "Recording",
    "Scenario",
    "check_film",
    "draw_without_screen",
    "record_episode",
    "serve",
    "write_film",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def draw_without_screen() -> None:
    """Let MuJoCo draw by EGL on a Linux machine without a screen, unless ``MUJOCO_GL`` says how it is to draw.

    MuJoCo decides when it is first imported: afterwards this changes nothing. Raises `InputError` if it cannot.
    """
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import_module("mujoco")
    except Exception as error:  # What fails, and how, depends on the machine's graphics library.
        backend = os.environ.get("MUJOCO_GL", "")
        raise InputError(
            f"MuJoCo cannot draw here with MUJOCO_GL={backend!r} ({error}): install EGL or OSMesa, and set MUJOCO_GL "
            "to egl or osmesa"
        ) from error
