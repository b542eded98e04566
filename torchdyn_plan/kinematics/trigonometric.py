"""Exact trigonometric form of a chain: its pose and Jacobian as one matrix product of sines.

Every entry of the forward kinematics of a revolute chain is a polynomial in cos qᵢ and sin qᵢ, hence a finite Fourier
series in integer combinations of the joint angles. Multiplying the chain's transforms as such series is exact (no
fit), and each joint adds a different frequency, so that terms never collide; what remains at run time is
``c + sin(q·C + b) · W``. Prismatic joints before the first revolute one shift the place alone and add ``q · L``; a
prismatic joint after a revolute one multiplies sines by q and has no such form.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.joint import Joint, cross_matrix

NEGLIGIBLE = 1e-12
MOST_TERMS = 3**8
"""Terms that a chain is expanded to at most: all those of eight revolute joints."""
MOST_COUNTABLE = 40
"""Joints whose frequencies are different integers of 64 bits."""


class Series(NamedTuple):
    """A finite Fourier series, Σ coefficientᵢ exp(i kᵢ·q)."""

    frequencies: Tensor
    """``(M, N)`` float64, integers."""
    coefficients: Tensor
    """``(M, …)`` complex128."""


@dataclass(frozen=True, kw_only=True)
class TrigonometricForm:
    """Constants of ``constant + sin(q·frequencies + phases) · weights + q·slopes``, all float64.

    The entries are the rows of the pose, each followed by the same row of the Jacobian: rotation, place, J_v and J_ω.
    """

    frequencies: Tensor
    """``(N, M)``, integers."""
    phases: Tensor
    """``(M,)`` [rad]"""
    weights: Tensor
    """``(M, 3, 4 + 2N)``"""
    constant: Tensor
    """``(3, 4 + 2N)``"""
    slopes: Tensor | None
    """``(N, 3, 4 + 2N)``: what prismatic joints add; None where there are none."""


class Expansion(NamedTuple):
    """The first joints of a chain, expanded; without the transform that comes after them."""

    pose: Series
    """``(M, 4, 4)``"""
    axes: list[Series]
    """``(M, 3)`` for each joint, in the base frame; empty for a prismatic one."""
    slopes: Tensor
    """As of `TrigonometricForm`."""


def expansions(joints: Sequence[Joint], *, negligible: float, most: int) -> Iterator[Expansion]:
    """The first joint of a chain, the first two, and so on, each of them exactly.

    A chain's series never gets shorter by another joint, so that the first one that is too long is where to stop.

    Raises:
        InputError: a prismatic joint follows a revolute one, or a series has more than ``most`` terms.
    """
    count = len(joints)
    pose = Series(torch.zeros(1, count, dtype=torch.float64), torch.eye(4, dtype=torch.complex128).unsqueeze(0))
    axes: list[Series] = []
    slopes = torch.zeros(count, 3, 4 + 2 * count, dtype=torch.float64)
    for index, joint in enumerate(joints):
        assert joint.axis is not None
        pose = Series(pose.frequencies, pose.coefficients @ joint.offset.to(torch.complex128))
        axis = Series(pose.frequencies, pose.coefficients[:, :3, :3] @ joint.axis.to(torch.complex128))
        if joint.kind == "prismatic":
            if len(pose.coefficients) > 1:
                raise InputError(f"prismatic joint {joint.name!r} follows a revolute one: it has no form in sines")
            slopes[index, :, 3] = axis.coefficients[0].real
            axes.append(Series(axis.frequencies[:0], axis.coefficients[:0]))
        else:
            axes.append(axis)
            pose = _turned(pose, joint.axis, index, negligible)
        if len(pose.coefficients) > most:
            raise InputError(
                f"the chain has more than {most} terms up to joint {joint.name!r}: too many for one product of sines"
            )
        yield Expansion(pose, list(axes), slopes)


def trigonometric_form(
    joints: Sequence[Joint], tool: Tensor, *, negligible: float = NEGLIGIBLE, most: int = MOST_TERMS
) -> TrigonometricForm:
    """Expand a chain exactly.

    Args:
        joints: those that move, base to tip.
        tool: ``(4, 4)``, from the last joint's frame to the tool.
        negligible: terms smaller than this [m, or as entries of a rotation] are rounding and dropped.
        most: terms that the series may have.

    Raises:
        InputError: a prismatic joint follows a revolute one, or there are more terms.
    """
    *_, (pose, axes, slopes) = expansions(joints, negligible=negligible, most=most)
    pose = Series(pose.frequencies, pose.coefficients @ tool.to(torch.complex128))
    entries = _entries(pose, axes, slopes)
    return _real_form(entries, negligible, slopes if bool(slopes.any()) else None)


def sine_counts(joints: Sequence[Joint], tools: Iterable[Tensor], *, negligible: float, most: int) -> Iterator[int]:
    """How many sines the `trigonometric_form` has of the first joint of a chain, of the first two, and so on.

    Counting takes a fraction of the time of the forms. A frequency has a cosine where any of its entries has a real
    part, and a sine where any has an imaginary one; to derive the place by joints exchanges the two.

    Args:
        joints: those that move, base to tip; at most `MOST_COUNTABLE`.
        tools: ``(4, 4)``, what is behind the first joint, behind the second, and so on.
        negligible: as of `trigonometric_form`.
        most: as of `trigonometric_form`.

    Raises:
        InputError: as of `expansions`.
    """
    # Each joint adds -1, 0 or 1: frequencies are numbers to the base 3.
    digits = 3 ** torch.arange(len(joints))
    turning: list[Tensor] = []
    for (series, axes, _), tool in zip(expansions(joints, negligible=negligible, most=most), tools, strict=False):
        turning.append(_codes(axes[-1].frequencies, digits, _parts_of(axes[-1].coefficients, negligible)))
        pose = series.coefficients[:, :3] @ tool.to(torch.complex128)
        posed, placed = _parts_of(pose.flatten(1), negligible), _parts_of(pose[:, :, 3], negligible)
        codes = _codes(series.frequencies, digits, posed | placed.flip(-1))
        yield len(torch.unique(torch.cat([codes, *turning])))


def _parts_of(coefficients: Tensor, negligible: float) -> Tensor:
    """Whether terms ``(M, K)`` have a real and an imaginary part in any entry, ``(M, 2)``."""
    return 2.0 * torch.view_as_real(coefficients.detach()).abs().amax(dim=1) > negligible


def _codes(frequencies: Tensor, digits: Tensor, parts: Tensor) -> Tensor:
    """One integer for each part that frequencies ``(M, N)`` have: k for real and -k for imaginary ones, of ±k once."""
    keys = (frequencies.long() * digits).sum(dim=1)
    return torch.stack([keys, -keys], dim=-1)[parts & (keys > 0).unsqueeze(-1)]


def _turned(pose: Series, axis: Tensor, index: int, negligible: float) -> Series:
    """``pose`` times the rotation about ``axis`` by joint ``index`` (Rodrigues): uuᵀ + cos(q)(1 - uuᵀ) + sin(q)[u]."""
    outer = torch.outer(axis, axis)
    plus = torch.complex(0.5 * (torch.eye(3, dtype=axis.dtype) - outer), -0.5 * cross_matrix(axis))
    fixed, turning = torch.eye(4, dtype=torch.complex128), torch.zeros(4, 4, dtype=torch.complex128)
    fixed[:3, :3] = outer.to(torch.complex128)
    turning[:3, :3] = plus
    step = torch.zeros_like(pose.frequencies)
    step[:, index] = 1.0
    frequencies = torch.cat([pose.frequencies, pose.frequencies + step, pose.frequencies - step])
    coefficients = torch.cat([pose.coefficients @ factor for factor in (fixed, turning, turning.conj())])
    kept = coefficients.detach().abs().amax(dim=(1, 2)) > negligible
    return Series(frequencies[kept], coefficients[kept])


def _entries(pose: Series, axes: Sequence[Series], slopes: Tensor) -> Series:
    """Series of the rows [rotation, place, J_v, J_ω]; J_v = ∂place/∂q, J_ω = the revolute axes in the base frame."""
    count = len(axes)
    zero = torch.zeros(1, count, dtype=torch.float64)
    parts = [zero, pose.frequencies, *(axis.frequencies for axis in axes)]
    frequencies, index = torch.unique(torch.cat(parts), dim=0, return_inverse=True)
    constant, posed, *turning = index.split([len(part) for part in parts])
    rows = torch.zeros(len(frequencies), 3, 4 + 2 * count, dtype=torch.complex128)
    speed = pose.coefficients[:, :3, 3, None] * 1j * pose.frequencies.unsqueeze(1)
    rows = rows.index_put((posed,), torch.cat([pose.coefficients[:, :3], speed, 0 * speed], dim=-1))
    for joint, (axis, place) in enumerate(zip(axes, turning, strict=True)):
        column = torch.zeros(len(place), 3, 4 + 2 * count, dtype=torch.complex128)
        column[:, :, 4 + count + joint] = axis.coefficients
        rows = rows.index_put((place,), column, accumulate=True)
    sliding = torch.zeros(1, 3, 4 + 2 * count, dtype=torch.complex128)
    sliding[0, :, 4 : 4 + count] = slopes[:, :, 3].T
    return Series(frequencies, rows.index_put((constant,), sliding, accumulate=True))


def _real_form(entries: Series, negligible: float, slopes: Tensor | None) -> TrigonometricForm:
    """Pair ±k into real sines: c·e^{ikq} + conj = 2 Re(c) cos(kq) - 2 Im(c) sin(kq)."""
    # The sign of a vector's first entry that is not zero.
    first = (entries.frequencies != 0.0).to(torch.uint8).argmax(dim=1, keepdim=True)
    sign = entries.frequencies.gather(1, first).squeeze(1)
    frequencies, rows = entries.frequencies[sign > 0], entries.coefficients[sign > 0]
    weights = torch.cat([2.0 * rows.real, -2.0 * rows.imag])
    phases = torch.zeros(len(weights), dtype=torch.float64)
    phases[: len(rows)] = torch.pi / 2
    kept = weights.detach().abs().amax(dim=(1, 2)) > negligible
    return TrigonometricForm(
        frequencies=frequencies.repeat(2, 1)[kept].T.contiguous(),
        phases=phases[kept],
        weights=weights[kept],
        constant=entries.coefficients[sign == 0][0].real,
        slopes=slopes,
    )
