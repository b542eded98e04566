"""Checks at the public entries: one clear error that names the offender and what was expected."""

import difflib
import math
from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor

from torchdyn_plan.errors import InputError, OutputError


def check_trailing_shape(name: str, tensor: Tensor, *trailing: int) -> None:
    """Raise `InputError` unless ``tensor`` has shape ``(*B, *trailing)``."""
    if not isinstance(tensor, Tensor):
        raise InputError(f"{name} must be a torch.Tensor, got {type(tensor).__name__}")
    if tensor.shape[tensor.ndim - len(trailing) :] != trailing or tensor.ndim < len(trailing):
        expected = ", ".join(["*B", *map(str, trailing)])
        raise InputError(f"{name} must have shape ({expected}), got {tuple(tensor.shape)}")


def check_finite(name: str, tensor: Tensor) -> None:
    """Raise `InputError` if ``tensor`` holds a NaN or an infinity."""
    # The sum is a quick look: only a sum that is not finite is worth the full one.
    if not math.isfinite(tensor.sum().item()) and not bool(torch.isfinite(tensor).all()):
        bad = int((~torch.isfinite(tensor)).sum())
        raise InputError(f"{name} must be finite, got {bad} NaN or infinite values of {tensor.numel()}")


def check_same_device(name: str, tensor: Tensor, device: torch.device, owner: str) -> None:
    """Raise `InputError` unless ``tensor`` lives on ``device``, the device of ``owner``."""
    if tensor.device != device:
        raise InputError(f"{name} is on {tensor.device}, but {owner} is on {device}: move one of them")


def check_input(
    name: str, tensor: Tensor, *trailing: int, device: torch.device, owner: str, finite: bool = True
) -> None:
    """All three checks of a network's input, unless it is compiled.

    Args:
        name: of the argument.
        tensor: must have shape ``(*B, *trailing)``.
        trailing: sizes of the last dimensions.
        device: of the network.
        owner: the network's name.
        finite: it must hold no NaN or infinity, either.
    """
    if torch.compiler.is_compiling():
        return
    check_trailing_shape(name, tensor, *trailing)
    check_same_device(name, tensor, device, owner)
    if finite:
        check_finite(name, tensor)


def check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    """Raise `InputError` unless ``value`` is one of ``choices``; suggests the nearest."""
    known = sorted(choices)
    if value not in known:
        near = difflib.get_close_matches(str(value), known, n=1)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        raise InputError(f"unknown {name} {value!r}{hint}; choose from {', '.join(known)}")


def check_number(
    name: str, value: float, *, minimum: float = -math.inf, maximum: float = math.inf, integer: bool = False
) -> None:
    """Raise `InputError` unless ``value`` is a finite number within ``[minimum, maximum]``."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"{name} must be a finite number, got {value!r}")
    if integer and not isinstance(value, int):
        raise InputError(f"{name} must be an integer, got {value!r}")
    if not minimum <= value <= maximum:
        bounds = f">= {minimum:g}" if maximum == math.inf else f"in [{minimum:g}, {maximum:g}]"
        raise InputError(f"{name} must be {bounds}, got {value!r}")


def check_device(device: torch.device | str) -> None:
    """Raise `InputError` unless ``device`` names a device that is here."""
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"device {str(device)!r} cannot be used: {reason}") from error


def check_writable_folder(folder: Path) -> Path:
    """Create ``folder`` if needed and return it; raise `OutputError` if it cannot be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".torchdyn_plan_probe"
        probe.write_bytes(b"x")
        probe.unlink()
    except OSError as error:
        raise OutputError(f"output folder {str(folder)!r} is not writable: {error.strerror or error}") from error
    return folder
