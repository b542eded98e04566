"""Pictures of the plane from above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from torch import Tensor

from torchdyn_plan.envs.chase.env import ChaseWorld

GROUND, GRID = (246, 246, 243), (226, 226, 221)
BASE, WALKER, GOAL = (31, 119, 180), (214, 96, 30), (200, 30, 40)
FINER = 2
"""Pictures are drawn so many times larger, and made smaller, which smooths their edges."""


def draw_world(
    world: ChaseWorld,
    base: Tensor,
    walker: Tensor,
    width: int,
    height: int,
    *,
    goal: Tensor | None = None,
    trails: Sequence[Tensor] = (),
) -> np.ndarray[Any, Any]:
    """A picture ``(height, width, 3)`` uint8 of a base and a walker, (2,) each [m].

    Args:
        world: whose circle of starts is seen, and how near counts as met.
        base: as above.
        walker: as above.
        width: of the picture.
        height: of the picture.
        goal: ``(2,)`` where they are to meet; None to leave it out [m].
        trails: of the base and of the walker until now, ``(T, 2)`` each [m].
    """
    size = np.array([width, height]) * FINER
    half = world.farthest + 1.5
    scale = size.min() / (2.0 * half)

    def pixel(place: Tensor) -> tuple[float, float]:
        x, y = place.tolist()
        return size[0] / 2 + scale * x, size[1] / 2 - scale * y

    def disc(place: Tensor, radius: float, **how: Any) -> None:
        (x, y), reach = pixel(place), scale * radius
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), **how)

    image = Image.new("RGB", (int(size[0]), int(size[1])), GROUND)
    draw = ImageDraw.Draw(image)
    middle = base.new_zeros(2)
    for metres in range(1, int(half * size.max() / size.min()) + 1):
        disc(middle, float(metres), outline=GRID, width=FINER)
    for trail, colour in zip(trails, (BASE, WALKER), strict=False):
        if len(trail) > 1:
            draw.line([pixel(place) for place in trail], fill=colour, width=2 * FINER)
    if goal is not None:
        disc(goal, 0.6 * world.radius, outline=GOAL, width=2 * FINER)
    disc(walker, 0.6 * world.radius, fill=WALKER)
    disc(base, world.radius, outline=BASE, width=2 * FINER)
    disc(base, 0.6 * world.radius, fill=BASE)
    return np.asarray(image.resize((width, height), Image.Resampling.LANCZOS))
