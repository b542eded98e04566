# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""What a world looks like, whoever draws it: a MuJoCo model, where the camera stands, and what the model lacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

if TYPE_CHECKING:
    import mujoco

Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, 0 to 1 each."""
TOOL, TARGET = (0.12, 0.47, 0.71, 1.0), (0.85, 0.37, 0.10, 1.0)


class Ball(NamedTuple):
    """A sphere that stands for a tool or a target that the model does not have."""

    radius: float
    """[m]"""
    colour: Colour


class Marks(NamedTuple):
    """K ellipsoids that are drawn beside a model, their axes along the world's."""

    places: np.ndarray[Any, Any]
    """``(K, 3)`` centres [m, world]."""
    sizes: np.ndarray[Any, Any]
    """``(K, 3)`` half-axes [m]; one of 0 is not drawn."""
    colours: np.ndarray[Any, Any]
    """``(K, 4)`` red, green, blue and opacity, 0 to 1 each."""

    @classmethod
    def ball(cls, place: Sequence[float], radius: float, colour: Colour) -> Self:
        """One sphere at ``place`` (3) [m, world]."""
        return cls(np.array([place], dtype=float), np.full((1, 3), radius), np.array([colour], dtype=float))


class Look(NamedTuple):
    """How a world is drawn."""

    model: mujoco.MjModel
    """Drawn at the generalised positions of `MovingTargetEnv.posture`."""
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place at which the camera looks [m, world]."""
    distance: float = 2.0
    """Of the camera from there [m]."""
    azimuth: float = 130.0
    """Direction in which the camera looks, from above [deg]."""
    elevation: float = -35.0
    """Of that direction over the horizon [deg]."""
    half_side: float = 1.0
    """Things happen within so much of `lookat` along x and y [m]; small marks are drawn a hundredth of it large."""
    tool: Ball | None = None
    """None where the model shows the tool."""
    target: Ball | None = None
    """None where the model shows the target."""


def bare_floor(half_side: float) -> mujoco.MjModel:
    """A model of nothing but a chequered square floor at height 0, from -``half_side`` to ``half_side`` [m]."""
    import mujoco

    spec = mujoco.MjSpec()
    builtin, mark = mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mujoco.mjtMark.mjMARK_NONE
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=builtin,
        mark=mark,
        rgb1=[0.90, 0.90, 0.88],
        rgb2=[0.84, 0.84, 0.82],
        width=256,
        height=256,
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[0.97, 0.97, 0.96],
        rgb2=[0.97, 0.97, 0.96],
        width=16,
        height=96,
    )
    material = spec.add_material(name="floor", texrepeat=[0.5, 0.5], texuniform=True, rgba=[0.95, 0.95, 0.95, 1.0])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half_side, half_side, 0.01],
        pos=[0.0, 0.0, -0.01],
        material="floor",
    )
    spec.visual.headlight.ambient[:], spec.visual.headlight.diffuse[:] = 0.6, 0.4
    return spec.compile()
