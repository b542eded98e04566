"""The two forms in which an arm is evaluated: one product of sines, or a product of a few transforms made of sines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise, repeat
from typing import Any, cast

import torch
from torch import Tensor, nn

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.joint import Joint
from torchdyn_plan.kinematics.trigonometric import (
    MOST_COUNTABLE,
    NEGLIGIBLE,
    TrigonometricForm,
    sine_counts,
    trigonometric_form,
)
from torchdyn_plan.precision import Precise, autocast_is_on, without_autocast

MOST_SINES = 128
"""With more sines than this, one product costs more than a product of transforms."""
MOST_TERMS = 2 * MOST_SINES + 1
"""A series with more terms than this has more than `MOST_SINES` sines: at least one for each pair of frequencies ±k."""
SINES_OF_A_JOINT = 9
"""Sines allowed per joint in a long chain: three joints make a transform of 26."""
LONGEST_PART = 12
"""Most joints in one transform."""


class SineForm(Precise):
    """Pose and Jacobian as ``sin(q·C + b) · W``, three tensor operations; the constant is a sine of frequency 0."""

    _frequencies: Tensor
    _phases: Tensor
    _pose_weights: Tensor
    _jacobian_weights: Tensor
    _pose_slopes: Tensor | None
    _jacobian_slopes: Tensor | None

    def __init__(self, form: TrigonometricForm) -> None:
        """Arrange the entries of ``form`` as a pose ``(4, 4)`` and a Jacobian ``(6, N)``.

        Two small matrix products are faster than splitting the result of one.
        """
        super().__init__()
        self.num_joints = len(form.frequencies)
        weights = torch.cat([_laid_out(form.constant.unsqueeze(0), 1.0), _laid_out(form.weights, 0.0)])
        slopes = None if form.slopes is None else _laid_out(form.slopes, 0.0)
        _register(self, "_frequencies", torch.nn.functional.pad(form.frequencies, (1, 0)))
        _register(self, "_phases", torch.nn.functional.pad(form.phases, (1, 0), value=torch.pi / 2))
        for name, columns in {"pose": slice(16), "jacobian": slice(16, None)}.items():
            _register(self, f"_{name}_weights", weights[:, columns].contiguous())
            _register(self, f"_{name}_slopes", None if slopes is None else slopes[:, columns].contiguous())

    def forward(self, joint_pos: Tensor) -> Tensor:
        """Pose ``(B, 4, 4)`` alone, for ``(B, N)``."""
        if autocast_is_on():
            return without_autocast(self.forward, joint_pos)
        # Looking up a buffer as a module's attribute costs as much as a small operation; its table is cheaper.
        own = cast(dict[str, Tensor], self._buffers)
        sines = torch.addmm(own["_phases"], joint_pos, own["_frequencies"]).sin()
        pose = torch.mm(sines, own["_pose_weights"])
        if own["_pose_slopes"] is not None:
            pose = torch.addmm(pose, joint_pos, own["_pose_slopes"])
        return pose.view(-1, 4, 4)

    def pose_and_jacobian(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Pose ``(B, 4, 4)`` and Jacobian ``(B, 6, N)``, for ``(B, N)``."""
        if autocast_is_on():
            return without_autocast(self.pose_and_jacobian, joint_pos)
        own: Any = self._buffers
        sines = torch.addmm(own["_phases"], joint_pos, own["_frequencies"]).sin_()
        pose, jacobian = torch.mm(sines, own["_pose_weights"]), torch.mm(sines, own["_jacobian_weights"])
        if own["_pose_slopes"] is not None:
            pose = torch.addmm(pose, joint_pos, own["_pose_slopes"])
            jacobian = torch.addmm(jacobian, joint_pos, own["_jacobian_slopes"])
        return pose.view(-1, 4, 4), jacobian.view(-1, 6, self.num_joints)


class TransformForm(Precise):
    """Pose and Jacobian as a product of transforms, each of a few neighbouring joints and itself a product of sines."""

    _frequencies: Tensor
    _phases: Tensor
    _weights: Tensor
    _constant: Tensor
    _slopes: Tensor | None
    _last_row: Tensor

    def __init__(self, forms: Sequence[TrigonometricForm]) -> None:
        """Concatenate the transforms, base to tip, so that all their sines are computed at once."""
        super().__init__()
        self.counts = tuple(len(form.frequencies) for form in forms)
        _register(self, "_frequencies", torch.block_diag(*(form.frequencies for form in forms)))
        _register(self, "_phases", torch.cat([form.phases for form in forms]))
        _register(self, "_weights", torch.block_diag(*(form.weights.flatten(1) for form in forms)))
        _register(self, "_constant", torch.cat([form.constant.flatten() for form in forms]))
        slides = any(form.slopes is not None for form in forms)
        _register(self, "_slopes", torch.block_diag(*map(_slopes, forms)) if slides else None)
        _register(self, "_last_row", torch.tensor([[[0.0, 0.0, 0.0, 1.0]]]))

    def forward(self, joint_pos: Tensor) -> Tensor:
        """Pose ``(B, 4, 4)`` alone, for ``(B, N)``."""
        if autocast_is_on():
            return without_autocast(self.forward, joint_pos)
        first, *others = self._transforms(joint_pos)
        rotation, place = first[..., :3], first[..., 3:4]
        for other in others:
            moved = rotation @ other[..., :4]
            rotation, place = moved[..., :3], place + moved[..., 3:]
        return self._pose(torch.cat([rotation, place], dim=-1))

    def pose_and_jacobian(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Pose ``(B, 4, 4)`` and Jacobian ``(B, 6, N)``, for ``(B, N)``.

        A transform after another is rotated by it, and lengthens the levers of its joints: v = v₁ + ω₁ × (R₁p₂).
        """
        if autocast_is_on():
            return without_autocast(self.pose_and_jacobian, joint_pos)
        first, *others = self._transforms(joint_pos)
        counts = iter(self.counts)
        rotation, place, speed, turn = first.split((3, 1, count := next(counts), count), dim=-1)
        for other in others:
            moved = rotation @ other
            rotation, lever, speed_here, turn_here = moved.split((3, 1, count := next(counts), count), dim=-1)
            speed = torch.cat([speed + torch.linalg.cross(turn, lever.expand_as(turn), dim=-2), speed_here], dim=-1)
            place, turn = place + lever, torch.cat([turn, turn_here], dim=-1)
        return self._pose(torch.cat([rotation, place], dim=-1)), torch.cat([speed, turn], dim=-2)

    def _transforms(self, joint_pos: Tensor) -> list[Tensor]:
        """Rows [rotation, place, J_v, J_ω] of each transform, ``(B, 3, 4 + 2n)``."""
        sines = torch.addmm(self._phases, joint_pos, self._frequencies).sin()
        entries = torch.addmm(self._constant, sines, self._weights)
        if self._slopes is not None:
            entries = torch.addmm(entries, joint_pos, self._slopes)
        parts = entries.split([12 + 6 * count for count in self.counts], dim=-1)
        return [part.unflatten(-1, (3, -1)) for part in parts]

    def _pose(self, rows: Tensor) -> Tensor:
        return torch.cat([rows, self._last_row.expand(rows.shape[0], 1, 4)], dim=-2)


def sine_form(joints: Sequence[Joint], tool: Tensor) -> SineForm:
    """The whole chain as one product of sines.

    Raises:
        InputError: a prismatic joint follows a revolute one.
    """
    return SineForm(trigonometric_form(joints, tool, negligible=_negligible(joints, tool)))


def transform_form(joints: Sequence[Joint], tool: Tensor) -> TransformForm:
    """The chain as the product of the fewest transforms with at most `MOST_SINES` sines in total.

    A chain of more than 14 joints may have `SINES_OF_A_JOINT` for each joint.
    """
    negligible, most = _negligible(joints, tool), max(MOST_SINES, SINES_OF_A_JOINT * len(joints))
    cuts = best_cuts(len(joints), _sines_of_parts(joints, tool, negligible), most)
    parts = [
        trigonometric_form(joints[start:stop], _behind(joints, stop, tool), negligible=negligible)
        for start, stop in pairwise(cuts)
    ]
    return TransformForm(parts)


def best_form(joints: Sequence[Joint], tool: Tensor) -> SineForm | TransformForm:
    """One product of sines if it has at most `MOST_SINES` sines, else a product of transforms."""
    negligible = _negligible(joints, tool)
    if len(joints) > MOST_COUNTABLE:
        return transform_form(joints, tool)
    try:
        # The first joints already show that the whole expansion would be large.
        for count in sine_counts(joints, repeat(tool), negligible=negligible, most=MOST_TERMS):
            if count > MOST_SINES:
                return transform_form(joints, tool)
    except InputError:
        return transform_form(joints, tool)
    return sine_form(joints, tool)


def best_cuts(count: int, sines: dict[tuple[int, int], int], most: int) -> tuple[int, ...]:
    """Where to cut a chain of ``count`` joints: into the fewest parts, at least two, with no more than ``most`` sines.

    Among cuts into equally many parts, the one with the fewest sines is taken, and of equals the first; if all cuts
    have more than ``most``, the one with the fewest. Dynamic programming over the number of parts and the first joint
    of a tail.

    Args:
        count: number of joints.
        sines: number of sines of each possible part, by its first joint and the one after its last.
        most: most sines in total.

    Returns:
        First joints of all parts, and ``count``.
    """
    best: tuple[int, tuple[int, ...]] | None = None
    tails: dict[int, tuple[int, tuple[int, ...]]] = {count: (0, (count,))}
    for number in range(1, count + 1):
        ways: dict[int, tuple[int, tuple[int, ...]]] = {}
        for (start, stop), own in sines.items():
            if stop in tails:
                rest, cuts = tails[stop]
                way = own + rest, (start, *cuts)
                ways[start] = min(ways.get(start, way), way)
        tails = ways
        if 0 in tails and number >= min(2, count) and (best is None or tails[0][0] < best[0]):
            best = tails[0]
        if best is not None and best[0] <= most:
            break
    assert best is not None  # At least the cut with one joint in each part exists.
    return best[1]


FORMS: dict[str, Callable[[Sequence[Joint], Tensor], SineForm | TransformForm]] = {
    "auto": best_form,
    "sines": sine_form,
    "transforms": transform_form,
}
"""The function that makes each form of an arm, by name."""


def _slopes(form: TrigonometricForm) -> Tensor:
    """The linear terms of the joints, ``(N, 12 + 6N)``."""
    if form.slopes is not None:
        return form.slopes.flatten(1)
    return torch.zeros(len(form.frequencies), form.constant.numel(), dtype=torch.float64)


def _sines_of_parts(joints: Sequence[Joint], tool: Tensor, negligible: float) -> dict[tuple[int, int], int]:
    """Number of sines of each part of a chain whose series has at most `MOST_TERMS` terms."""
    sines = {}
    for start in range(len(joints)):
        stops = range(start + 1, min(start + LONGEST_PART, len(joints)) + 1)
        tools = (_behind(joints, stop, tool) for stop in stops)
        counts = sine_counts(joints[start : stops[-1]], tools, negligible=negligible, most=MOST_TERMS)
        try:
            for stop, number in zip(stops, counts, strict=True):
                sines[start, stop] = number
        except InputError:
            continue
    return sines


def _behind(joints: Sequence[Joint], stop: int, tool: Tensor) -> Tensor:
    """The transform after the part of a chain that ends at joint ``stop``, before the next joint's offset."""
    return tool if stop == len(joints) else torch.eye(4, dtype=torch.float64)


def _negligible(joints: Sequence[Joint], tool: Tensor) -> float:
    """Threshold for dropping terms: 0 if offsets have gradients, because a term of 0 may have a non-zero gradient."""
    graded = tool.requires_grad or any(joint.offset.requires_grad for joint in joints)
    return -1.0 if graded else NEGLIGIBLE


def _laid_out(rows: Tensor, corner: float) -> Tensor:
    """Entries ``(M, 3, 4 + 2N)`` as flat poses and Jacobians ``(M, 16 + 6N)``, with ``corner`` last in the pose."""
    count = (rows.shape[-1] - 4) // 2
    pose, speed, turn = rows.split((4, count, count), dim=-1)
    last = rows.new_tensor([0.0, 0.0, 0.0, corner]).expand(len(rows), 4)
    return torch.cat([pose.flatten(1), last, speed.flatten(1), turn.flatten(1)], dim=1)


def _register(module: nn.Module, name: str, value: Tensor | None) -> None:
    module.register_buffer(name, value, persistent=False)
