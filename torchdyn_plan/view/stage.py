# viser, mjviser and mujoco hide names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""One recording in the browser: bodies of its world, its layers and its name."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np

from torchdyn_plan.envs.look import Look, Marks
from torchdyn_plan.view.marks import marks_at
from torchdyn_plan.view.recording import Recording

VISIBLE_GROUPS = 3
"""MuJoCo draws geoms of the groups below this one."""
APART = 3.0
"""Distance between the centres of two worlds side by side, in half sides of their squares."""
LIFT = 1.3
"""Height of a planner's name above the centre of its world, in half sides."""


class Stage:
    """Draws a recording under one name of the page's scene tree."""

    def __init__(self, server: Any, root: str, recording: Recording, place: np.ndarray[Any, Any]) -> None:
        """Add everything that the recording needs under ``root``, shifted by ``place`` (3) [m]."""
        self.server, self.recording, look = server, recording, recording.look
        self._model, self._data = look.model, mujoco.MjData(look.model)
        self._root = server.scene.add_frame(root, show_axes=False, position=place)
        self._bodies = {
            body: server.scene.add_mesh_trimesh(f"{root}/body_{body}", mesh)
            for body, mesh in body_meshes(look.model).items()
        }
        above = np.array(look.lookat) + np.array([0.0, 0.0, LIFT * look.half_side])
        name = recording.scenario.planner.replace("_", " ")
        self._label = server.scene.add_label(f"{root}/name", name, position=above)
        self._layers = {
            name: self._add_layer(f"{root}/{name}", marks) for name, marks in marks_at(recording, 0).items()
        }

    def _add_layer(self, name: str, marks: Marks) -> Any:
        import trimesh

        ball = trimesh.creation.icosphere(subdivisions=1 if len(marks.places) > 1 else 3)
        turn = np.tile([1.0, 0.0, 0.0, 0.0], (len(marks.places), 1))
        how: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False, "lod": "off"}
        return self.server.scene.add_batched_meshes_simple(
            name, ball.vertices, ball.faces, turn, marks.places, **as_batch(marks), **how
        )

    def show(self, step: int, hidden: Collection[str] = ()) -> None:
        """Show control step ``step`` without the layers ``hidden``; viser sends what has changed."""
        now = min(step, self.recording.length)
        self._data.qpos[:] = self.recording.posture[now]
        mujoco.mj_kinematics(self._model, self._data)
        for body, handle in self._bodies.items():
            handle.position, handle.wxyz = self._data.xpos[body].copy(), self._data.xquat[body].copy()
        for name, marks in marks_at(self.recording, now).items():
            handle = self._layers[name]
            handle.visible = name not in hidden
            if handle.visible:
                handle.batched_positions = marks.places.astype(np.float32)
                for entry, value in as_batch(marks).items():
                    setattr(handle, entry, value)

    def remove(self) -> None:
        """Remove everything from the page."""
        self._root.remove()


def as_batch(marks: Marks) -> dict[str, Any]:
    """Sizes, colours and opacities in viser's format; invisible marks have size 0."""
    opacity = marks.colours[:, 3].astype(np.float32)
    return {
        "batched_scales": (marks.sizes * (opacity > 0.0)[:, None]).astype(np.float32),
        "batched_colors": (255.0 * marks.colours[:, :3]).round().astype(np.uint8),
        "batched_opacities": opacity,
    }


def body_meshes(model: mujoco.MjModel) -> dict[int, Any]:
    """A mesh for each visible body of ``model``, in its own frame."""
    from mjviser.conversions import merge_geoms

    plain, found = with_plain_colours(model), {}
    for body in range(model.nbody):
        geoms = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
        shown = [geom for geom in geoms if model.geom_group[geom] < VISIBLE_GROUPS and plain.geom_rgba[geom, 3] > 0.0]
        if shown:
            found[body] = merge_geoms(plain, shown)
    return found


def with_plain_colours(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of ``model`` whose materials have the mean colour of their textures, because the page has no textures."""
    plain = copy.copy(model)
    for material in range(model.nmat):
        texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
        if texture >= 0:
            start, channels = model.tex_adr[texture], model.tex_nchannel[texture]
            count = model.tex_width[texture] * model.tex_height[texture] * channels
            pixels = model.tex_data[start : start + count].reshape(-1, channels)
            plain.mat_rgba[material, :3] *= pixels[:, :3].mean(axis=0) / 255.0
    return plain


def camera_of(look: Look) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Position and focus of the look's camera (3,) [m, world], and the direction to its right."""
    azimuth, elevation = math.radians(look.azimuth), math.radians(look.elevation)
    level = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    forward = math.cos(elevation) * level + np.array([0.0, 0.0, math.sin(elevation)])
    lookat = np.array(look.lookat)
    return lookat - look.distance * forward, lookat, np.array([level[1], -level[0], 0.0])


def places_of(look: Look, count: int) -> list[np.ndarray[Any, Any]]:
    """Centres of ``count`` worlds, placed side by side as seen by the camera: (3,) [m] each."""
    _, _, right = camera_of(look)
    return [(number - (count - 1) / 2) * APART * look.half_side * right for number in range(count)]
