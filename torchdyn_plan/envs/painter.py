# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""Pictures of a simulated world, drawn off screen by MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.look import Look, Marks
from torchdyn_plan.errors import InputError

LARGEST = 1280
"""Longest side of a picture [pixels]."""


class Painter:
    """Draws states of one world from one place; graphics start with the first picture."""

    def __init__(self, look: Look) -> None:
        """Draw the model of ``look`` from where its camera stands."""
        self.model, self.data = look.model, mujoco.MjData(look.model)
        self.camera = mujoco.MjvCamera()
        self.camera.lookat[:], self.camera.distance = look.lookat, look.distance
        self.camera.azimuth, self.camera.elevation = look.azimuth, look.elevation
        self._renderer: mujoco.Renderer | None = None

    def picture(
        self, qpos: np.ndarray[Any, Any], width: int, height: int, marks: Sequence[Marks] = ()
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
            _add(renderer.scene, mark)
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


def _add(scene: mujoco.MjvScene, marks: Marks) -> None:
    """Add ``marks`` that can be seen to a scene that is about to be drawn; raises `InputError` if it is full."""
    seen = (marks.colours[:, 3] > 0.0) & (marks.sizes.min(axis=1) > 0.0)
    count, turn = int(seen.sum()), np.eye(3).flatten()
    if scene.ngeom + count > scene.maxgeom:
        raise InputError(f"a picture shows at most {scene.maxgeom} things, got {scene.ngeom + count}")
    kept = (marks.places[seen], marks.sizes[seen], marks.colours[seen].astype(np.float32))
    for place, size, colour in zip(*kept, strict=True):
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_ELLIPSOID, size, place, turn, colour)
        # No shadows of what is not there.
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        scene.ngeom += 1
