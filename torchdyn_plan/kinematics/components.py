"""A chain's pose and Jacobian component by component, for a compiler to fuse into one loop.

Run eagerly this is slow, an operation for each product; compiled it is the fastest form there is. Components are
tensors of one shape or plain numbers, and products with 0 and 1 are left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdyn_plan.kinematics.joint import Joint

Component = Tensor | float
Vector = list[Component]
Matrix = list[Vector]


def add(left: Component, right: Component) -> Component:
    """Sum, without an operation where one side is 0."""
    if isinstance(left, float) and left == 0.0:
        return right
    if isinstance(right, float) and right == 0.0:
        return left
    return left + right


def multiply(left: Component, right: Component) -> Component:
    """Product, without an operation where one side is 0, 1 or -1."""
    if isinstance(right, float):
        left, right = right, left
    if isinstance(left, float):
        if left == 0.0:
            return 0.0
        if left in (1.0, -1.0):
            return right if left == 1.0 else -right
    return left * right


def subtract(left: Component, right: Component) -> Component:
    """Difference, without an operation where one side is 0."""
    if isinstance(left, float) and left == 0.0:
        return -right
    return left if isinstance(right, float) and right == 0.0 else left - right


def dot(left: Sequence[Component], right: Sequence[Component]) -> Component:
    """Sum of products."""
    total: Component = 0.0
    for a, b in zip(left, right, strict=True):
        total = add(total, multiply(a, b))
    return total


def cross(left: Vector, right: Vector) -> Vector:
    """Vector product."""
    return [subtract(multiply(left[i], right[j]), multiply(left[j], right[i])) for i, j in ((1, 2), (2, 0), (0, 1))]


def matmul(left: Matrix, right: Matrix) -> Matrix:
    """Matrix product."""
    columns = list(zip(*right, strict=True))
    return [[dot(row, column) for column in columns] for row in left]


class ComponentForm:
    """Pose and Jacobian of a chain from its joints' positions, one component after another."""

    def __init__(self, joints: Sequence[Joint], tool: Tensor) -> None:
        """Take the joints that move, base to tip, and the transform from the last one to the tool."""
        self.kinds = tuple(joint.kind for joint in joints)
        self.offsets = tuple(_clean(joint.offset) for joint in joints)
        self.axes = tuple(_clean(joint.axis) for joint in joints if joint.axis is not None)
        self.tool = _clean(tool)

    def __call__(self, joint_pos: Sequence[Tensor]) -> tuple[Matrix, Vector, Matrix]:
        """Rotation (3, 3), place (3) and the Jacobian's columns (N, 6), rows [v; ω], in the base frame."""
        rotation: Matrix = [[float(i == j) for j in range(3)] for i in range(3)]
        place: Vector = [0.0] * 3
        places, axes = [], []
        for q, kind, offset, axis in zip(joint_pos, self.kinds, self.offsets, self.axes, strict=True):
            rotation, place = _moved(rotation, place, offset)
            axes.append([dot(row, axis) for row in rotation])
            places.append(place)
            if kind == "prismatic":
                place = [add(p, multiply(q, a)) for p, a in zip(place, axes[-1], strict=True)]
            else:
                rotation = matmul(rotation, _rotation(axis, q))
        rotation, place = _moved(rotation, place, self.tool)
        columns = []
        for kind, axis, start in zip(self.kinds, axes, places, strict=True):
            lever = [subtract(end, begin) for end, begin in zip(place, start, strict=True)]
            columns.append([*axis, 0.0, 0.0, 0.0] if kind == "prismatic" else [*cross(axis, lever), *axis])
        return rotation, place, columns


def damped_least_squares(columns: Matrix, error: Sequence[Component], damping: Component) -> Vector:
    """Joint step Jᵀ(JJᵀ + λ²I)⁻¹e of `dls_step` by an unrolled LDLᵀ, whose pivots are at least about λ²."""
    size, square = len(error), multiply(damping, damping)
    rows = list(zip(*columns, strict=True))
    # L·D and L, column by column; a division takes as long as ten products, so each pivot is inverted once.
    scaled: Matrix = [[0.0] * size for _ in range(size)]
    lower: Matrix = [[0.0] * size for _ in range(size)]
    inverses: Vector = []
    for j in range(size):
        pivot = subtract(add(dot(rows[j], rows[j]), square), dot(scaled[j][:j], lower[j][:j]))
        inverses.append(1.0 / pivot)
        for i in range(j + 1, size):
            scaled[i][j] = subtract(dot(rows[i], rows[j]), dot(scaled[i][:j], lower[j][:j]))
            lower[i][j] = multiply(scaled[i][j], inverses[j])
    weights = list(error)
    for i in range(size):
        weights[i] = subtract(weights[i], dot(lower[i][:i], weights[:i]))
    weights = [multiply(weight, inverse) for weight, inverse in zip(weights, inverses, strict=True)]
    for i in reversed(range(size)):
        below = [lower[k][i] for k in range(i + 1, size)]
        weights[i] = subtract(weights[i], dot(below, weights[i + 1 :]))
    return [dot(column, weights) for column in columns]


def _moved(rotation: Matrix, place: Vector, offset: Matrix) -> tuple[Matrix, Vector]:
    """A pose times a fixed transform."""
    way = [dot(row, [line[3] for line in offset[:3]]) for row in rotation]
    turned = matmul(rotation, [line[:3] for line in offset[:3]])
    return turned, [add(p, w) for p, w in zip(place, way, strict=True)]


def _rotation(axis: Vector, angle: Tensor) -> Matrix:
    """Rotation about a fixed unit vector (Rodrigues)."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y, z = axis
    skew: Matrix = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    rows: Matrix = []
    for i in range(3):
        row: Vector = []
        for j in range(3):
            outer = multiply(axis[i], axis[j])
            level = subtract(float(i == j), outer)
            row.append(add(add(outer, multiply(level, cos)), multiply(skew[i][j], sin)))
        rows.append(row)
    return rows


def _clean(value: Tensor) -> list:
    """Numbers of a constant tensor; those within 1e-12 of 0, 1 or -1 are rounding of those."""
    near = value.detach().round().clamp(-1.0, 1.0)
    return torch.where((value - near).abs() < 1e-12, near, value.detach()).tolist()
