"""Watch an episode: record it step by step, and show it in the browser or write it to a file."""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING

from torchdyn_plan.errors import InputError
from torchdyn_plan.lazy import lazy_names

if TYPE_CHECKING:
    from torchdyn_plan.view.files import check_film, write_film
    from torchdyn_plan.view.page import Page, serve
    from torchdyn_plan.view.pictures import Film
    from torchdyn_plan.view.recording import Recording, Scenario, record_episode

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

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "files": ("check_film", "write_film"),
        "page": ("Page", "serve"),
        "pictures": ("Film",),
        "recording": ("Recording", "Scenario", "record_episode"),
    },
)


def draw_without_screen() -> None:
    """Let MuJoCo render with EGL on a Linux machine without a screen, unless ``MUJOCO_GL`` is set.

    MuJoCo decides when it is first imported; afterwards this has no effect. Raises `InputError` if it cannot render.
    """
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import_module("mujoco")
    except Exception as error:  # The exception depends on the machine's graphics library.
        backend = os.environ.get("MUJOCO_GL", "")
        raise InputError(
            f"MuJoCo cannot draw here with MUJOCO_GL={backend!r} ({error}): install EGL or OSMesa, and set MUJOCO_GL "
            "to egl or osmesa"
        ) from error
