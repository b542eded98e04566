"""Checks at the public entries: one clear error that names the offender and what was expected.

Values are looked at here, and nowhere while a model is compiled. Under ``torch.vmap`` they are looked at through
``torch.func.debug_unwrap``, which shows those of all rows together and otherwise the tensor itself.
"""

import difflib
import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import debug_unwrap

from torchdyn_plan.errors import InputError

LARGEST = 10**18 - 1
"""No whole number that somebody means is larger."""
MOST_THREADS = 1024


POSE_SIZE = 7
"""Entries of a pose: a position and a quaternion wxyz."""
POINT_SIZES = (2, 3)
"""Coordinates D of a point: x and y in a plane, or x, y and z in space."""


def check_points(name: str, tensor: Tensor, *leading: int) -> int:
    """Number of coordinates D of ``tensor`` (*B, *leading, D); raises `InputError` unless it holds points."""
    if not isinstance(tensor, Tensor):
        raise InputError(f"{name} must be a torch.Tensor, got {type(tensor).__name__}")
    size = tensor.shape[-1] if tensor.ndim else 0
    if size not in POINT_SIZES:
        shapes = " or ".join(f"({', '.join(['*B', *map(str, leading), str(one)])})" for one in POINT_SIZES)
        raise InputError(f"{name} must have shape {shapes}, got {tuple(tensor.shape)}")
    check_trailing_shape(name, tensor, *leading, size)
    return size


def check_trailing_shape(name: str, tensor: Tensor, *trailing: int) -> None:
    """Raise `InputError` unless ``tensor`` has shape ``(*B, *trailing)``."""
    if not isinstance(tensor, Tensor):
        raise InputError(f"{name} must be a torch.Tensor, got {type(tensor).__name__}")
    if tensor.shape[tensor.ndim - len(trailing) :] != trailing or tensor.ndim < len(trailing):
        expected = ", ".join(["*B", *map(str, trailing)])
        raise InputError(f"{name} must have shape ({expected}), got {tuple(tensor.shape)}")


def check_finite(name: str, tensor: Tensor) -> None:
    """Raise `InputError` if ``tensor`` holds a NaN or an infinity; nothing is looked at while compiling."""
    if torch.compiler.is_compiling():
        return
    tensor = debug_unwrap(tensor)
    # The sum is a quick look: only a sum that is not finite is worth the full one.
    if not math.isfinite(tensor.sum().item()) and not bool(torch.isfinite(tensor).all()):
        bad = int((~torch.isfinite(tensor)).sum())
        raise InputError(f"{name} must be finite, got {bad} NaN or infinite values of {tensor.numel()}")


def check_same_device(name: str, tensor: Tensor, device: torch.device, owner: str) -> None:
    """Raise `InputError` unless ``tensor`` lives on ``device``, the device of ``owner``."""
    if tensor.device != device:
        raise InputError(f"{name} is on {tensor.device}, but {owner} is on {device}: move one of them")


def check_floating(name: str, tensor: Tensor) -> None:
    """Raise `InputError` unless ``tensor`` holds floating-point numbers."""
    if not tensor.is_floating_point():
        raise InputError(f"{name} must hold floating-point numbers, got {tensor.dtype}")


def network_input(
    name: str, tensor: Tensor, *trailing: int, like: Tensor, owner: str = "the network", finite: bool = True
) -> Tensor:
    """``tensor`` in the precision of ``like``, after all checks of a network's input, unless it is compiled.

    Args:
        name: of the argument.
        tensor: must have shape ``(*B, *trailing)`` and hold floating-point numbers.
        trailing: sizes of the last dimensions.
        like: a constant of the network, in whose precision and on whose device it computes.
        owner: the network's name.
        finite: it must hold no NaN or infinity, either.
    """
    if not torch.compiler.is_compiling():
        # One quick look passes nearly always; the checks one by one say what is wrong.
        good = isinstance(tensor, Tensor) and tensor.shape[-len(trailing) :] == trailing
        good = good and tensor.device == like.device and tensor.is_floating_point()
        if not good or (finite and not math.isfinite(debug_unwrap(tensor).sum().item())):
            check_trailing_shape(name, tensor, *trailing)
            check_same_device(name, tensor, like.device, owner)
            check_floating(name, tensor)
            if finite:
                check_finite(name, tensor)
    return tensor if tensor.dtype == like.dtype else tensor.to(like.dtype)


def hides_values(tensor: Tensor) -> bool:
    """Whether results may not depend on looking at ``tensor``: it is compiled, or stands for many under ``vmap``."""
    return torch.compiler.is_compiling() or debug_unwrap(tensor) is not tensor


def is_followed(*tensors: Tensor) -> bool:
    """Whether derivatives are taken through one of ``tensors``, in any of PyTorch's ways."""
    if forward_ad._current_level >= 0:
        return True
    grad = torch.is_grad_enabled()
    return any((grad and tensor.requires_grad) or debug_unwrap(tensor) is not tensor for tensor in tensors)


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
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > LARGEST:
        raise InputError(f"{name} must be a number of at most 18 digits, got one of {len(str(abs(value))[:4000])}")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"{name} must be a finite number, got {value!r}")
    if integer and not isinstance(value, int):
        raise InputError(f"{name} must be an integer, got {value!r}")
    if not minimum <= value <= maximum:
        bounds = f">= {minimum:g}" if maximum == math.inf else f"in [{minimum:g}, {maximum:g}]"
        raise InputError(f"{name} must be {bounds}, got {value!r}")


def check_vector(name: str, values: Sequence[float]) -> tuple[float, ...]:
    """``values`` as a tuple; raises `InputError` unless they are a number for each axis of a plane or of space."""
    if not isinstance(values, (tuple, list)) or len(values) not in POINT_SIZES:
        raise InputError(f"{name} must be two or three numbers, got {values!r}")
    for value in values:
        check_number(name, value)
    return tuple(map(float, values))


def check_count(name: str, value: int, *, minimum: int = 1, maximum: int = 10_000_000) -> None:
    """Raise `InputError` unless ``value`` is a number of things within ``[minimum, maximum]``."""
    check_number(name, value, minimum=minimum, integer=True)
    if value > maximum:
        raise InputError(f"{name} must be <= {maximum}, got {value}")


def check_seed(seed: int) -> None:
    """Raise `InputError` unless ``seed`` is one from which series of episodes and of draws can be numbered."""
    check_count("seed", seed, minimum=0, maximum=2**32 - 1)


def check_threads(name: str, value: int) -> None:
    """Raise `InputError` unless ``value`` is a number of threads, or 0 for all cores."""
    check_count(name, value, minimum=0, maximum=MOST_THREADS)


def check_device(device: torch.device | str) -> None:
    """Raise `InputError` unless ``device`` names a device that is here."""
    try:
        # A device that holds no numbers, as meta, has no item.
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"device {str(device)!r} cannot be used: {reason}") from error
