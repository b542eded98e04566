"""Exact trigonometric form of a revolute chain: its pose and Jacobian as one matrix product of sines.

Every entry of the forward kinematics of a revolute chain is a polynomial in cos qᵢ and sin qᵢ, hence a finite Fourier
series in integer combinations of the joint angles. Multiplying the chain's transforms as such series is exact (no
fit); what remains at run time is ``sin(q·C + b) · W``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_NEGLIGIBLE = 1e-12

Series = dict[tuple[int, ...], Tensor]
"""Coefficient of ``exp(i k·q)`` for each integer vector k; coefficients are complex tensors of one shape."""


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One step along a chain: a fixed transform, then (if ``axis`` is given) a rotation about that axis."""

    offset: Tensor
    """``(4, 4)`` float64, from the previous frame [m]."""
    axis: Tensor | None
    """``(3,)`` unit vector in the joint's own frame, or None for a fixed joint."""


@dataclass(frozen=True, kw_only=True)
class TrigonometricForm:
    """Constants of ``sin(q·frequencies + phases) · weights``, all float64."""

    frequencies: Tensor
    """``(N, M)``, integers."""
    phases: Tensor
    """``(M,)`` [rad]"""
    weights: Tensor
    """``(M, 16 + 6N)``: the pose row by row, then the Jacobian row by row, [v; ω] in the base frame."""


def trigonometric_form(chain: Sequence[Joint]) -> TrigonometricForm:
    """Expand ``chain`` (base to tip) exactly; terms below 1e-12 of the entries' size are rounding and dropped."""
    count = sum(joint.axis is not None for joint in chain)
    pose: Series = {(0,) * count: torch.eye(4, dtype=torch.complex128)}
    axes: list[Series] = []
    for joint in chain:
        pose = _times(pose, {(0,) * count: joint.offset.to(torch.complex128)})
        if joint.axis is not None:
            axes.append(_apply(pose, joint.axis))
            pose = _times(pose, _rotation(joint.axis, len(axes) - 1, count))
    return _real_form(_entries(pose, axes, count), count)


def _entries(pose: Series, axes: Sequence[Series], count: int) -> Series:
    """Series of the flat vector (pose 16, Jacobian 6N); v = ∂position/∂q, ω = the joint axes in the base frame."""
    entries: Series = {}
    for k in set(pose).union(*axes):
        flat = torch.zeros(16 + 6 * count, dtype=torch.complex128)
        if k in pose:
            flat[:16] = pose[k].reshape(16)
            speed = pose[k][:3, 3, None] * 1j * torch.tensor(k, dtype=torch.complex128)
            flat[16 : 16 + 3 * count] = speed.reshape(-1)
        turn = torch.stack([axis.get(k, torch.zeros(3, dtype=torch.complex128)) for axis in axes], dim=-1)
        flat[16 + 3 * count :] = turn.reshape(-1)
        entries[k] = flat
    return entries


def _real_form(entries: Series, count: int) -> TrigonometricForm:
    """Pair ±k into real sines: c·e^{ikq} + conj = 2 Re(c) cos(kq) - 2 Im(c) sin(kq)."""
    frequencies, phases, weights = [], [], []
    for k in sorted(entries):
        if k < (0,) * count:
            continue
        factor = 1.0 if not any(k) else 2.0
        for phase, part in ((torch.pi / 2, entries[k].real), (0.0, -entries[k].imag)):
            weight = factor * part
            weight = torch.where(weight.abs() > _NEGLIGIBLE, weight, torch.zeros_like(weight))
            if bool(weight.any()):
                frequencies.append(k)
                phases.append(phase)
                weights.append(weight)
    return TrigonometricForm(
        frequencies=torch.tensor(frequencies, dtype=torch.float64).T.contiguous(),
        phases=torch.tensor(phases, dtype=torch.float64),
        weights=torch.stack(weights),
    )


def _rotation(axis: Tensor, index: int, count: int) -> Series:
    """Rotation about ``axis`` by joint ``index`` (Rodrigues) as a series: uuᵀ + cos(q)(1 - uuᵀ) + sin(q)[u]."""
    u = axis / axis.norm()
    outer = torch.outer(u, u)
    cross = torch.linalg.cross(u.expand(3, 3), torch.eye(3, dtype=u.dtype)).T
    plus = torch.complex(0.5 * (torch.eye(3, dtype=u.dtype) - outer), -0.5 * cross)
    fixed = torch.eye(4, dtype=torch.complex128)
    fixed[:3, :3] = outer.to(torch.complex128)
    turning = torch.zeros(4, 4, dtype=torch.complex128)
    turning[:3, :3] = plus
    up = tuple(int(i == index) for i in range(count))
    down = tuple(-int(i == index) for i in range(count))
    return {(0,) * count: fixed, up: turning, down: turning.conj()}


def _times(left: Series, right: Series) -> Series:
    product: Series = {}
    for k, a in left.items():
        for m, b in right.items():
            key = tuple(i + j for i, j in zip(k, m, strict=True))
            product[key] = product[key] + a @ b if key in product else a @ b
    return {k: c for k, c in product.items() if float(c.abs().max()) > _NEGLIGIBLE}


def _apply(pose: Series, axis: Tensor) -> Series:
    """Series of a joint axis turned into the base frame."""
    vector = (axis / axis.norm()).to(torch.complex128)
    return {k: c[:3, :3] @ vector for k, c in pose.items()}
