# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""Pictures of a simulated world, drawn off screen by MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError

ELEVATION = -35.0
"""Cameras look down at this angle [deg]."""
LARGEST = 1280
"""Longest side of a picture [pixels]."""


class Sphere(NamedTuple):
    """Something that is drawn in addition to the model."""

    place: tuple[float, ...]
    """Centre (3) [m, world]."""
    radius: float
    """[m]"""
    colour: tuple[float, float, float, float]
    """Red, green, blue and opacity, 0 to 1 each."""


class Painter:
    """Draws states of one model from one place; graphics start with the first picture."""

    def __init__(
        self, model: mujoco.MjModel, *, lookat: tuple[float, float, float], distance: float, azimuth: float
    ) -> None:
        """Look at the point ``lookat`` [m, world] from ``distance`` [m] and ``azimuth`` [deg]."""
        self.model, self.data = model, mujoco.MjData(model)
        self.camera = mujoco.MjvCamera()
        self.camera.lookat[:], self.camera.distance = lookat, distance
        self.camera.azimuth, self.camera.elevation = azimuth, ELEVATION
        self._renderer: mujoco.Renderer | None = None

    def picture(
        self, qpos: np.ndarray[Any, Any], width: int, height: int, marks: Sequence[Sphere] = ()
    ) -> np.ndarray[Any, Any]:
        """A picture ``(height, width, 3)`` uint8 of the model at generalised positions ``qpos`` (nq,), with ``marks``.

        Raises:
            InputError: a size is no whole number of pixels up to `LARGEST`, or this machine cannot draw.
        """
        for name, size in (("width", width), ("height", height)):
            check_number(name, size, minimum=1, maximum=LARGEST, integer=True)
        renderer = self._sized(width, height)
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)
        renderer.update_scene(self.data, self.camera)
        for mark in marks:
            geom = renderer.scene.geoms[renderer.scene.ngeom]
            size, turn = np.full(3, mark.radius), np.eye(3).flatten()
            place, colour = np.array(mark.place), np.array(mark.colour, dtype=np.float32)
            mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, place, turn, colour)
            renderer.scene.ngeom += 1
        return renderer.render().copy()

    def _sized(self, width: int, height: int) -> mujoco.Renderer:
        renderer = self._renderer
        if renderer is not None and (renderer.width, renderer.height) == (width, height):
            return renderer
        if renderer is not None:
            renderer.close()
        self.model.vis.global_.offwidth = max(self.model.vis.global_.offwidth, width)
        self.model.vis.global_.offheight = max(self.model.vis.global_.offheight, height)
        try:
            self._renderer = mujoco.Renderer(self.model, height, width)
        except Exception as error:  # What fails, and how, depends on the machine's graphics library.
            raise InputError(
                f"this machine cannot draw ({error}): without a screen set MUJOCO_GL=egl or MUJOCO_GL=osmesa before "
                "Python starts"
            ) from error
        return self._renderer
