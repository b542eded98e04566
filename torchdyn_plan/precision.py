"""In which precision is computed, whatever comes in, however networks are stored, and whatever autocast is on.

One rule for every network, planner and solver. Half precision knows a metre to half a millimetre (float16) or four
(bfloat16), while a target's motion shows in differences of positions that are smaller. So

- what has to do with space and time is computed in float32 or float64: in the precision of a module's constants, which
  ``half()`` and ``bfloat16()`` leave in float32 (`Precise`); these make dense layers of hidden features alone smaller,
- inputs may have any floating type, and results have the type of the input,
- autocast changes nothing (`without_autocast`). Given the dense layers alone it would still move a forecast by 2 mm in
  the middle and by more than 4 cm in one case of twenty (300 steps ahead, bfloat16, a ball on a table), and networks of
  this size gain no time by it. A person's own function in a planner runs as autocast says.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, Self, TypeVar

import torch
from torch import Tensor, nn

EXACT = torch.float32, torch.float64
"""Types in which space and time are computed."""
HALVES = torch.float16, torch.bfloat16
"""Types in which they are not."""
KINDS = ("cpu", "cuda", "mps", "xpu", "mtia", "maia", "hpu", "ipu", "xla", "privateuseone")
AUTOCASTING = tuple(kind for kind in KINDS if torch.amp.is_autocast_available(kind))
"""Devices that may have autocast on."""
autocast_is_on = torch._C._is_any_autocast_enabled
"""Whether autocast is on, on any device: what layers of torch themselves ask."""

Given = ParamSpec("Given")
Result = TypeVar("Result")


class Precise(nn.Module):
    """A module whose buffers are constants of geometry: at least float32, for any dtype of its parameters."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """As of `nn.Module`, which moves and converts by it; buffers are converted from what they were."""
        before = dict(self._buffers)
        super()._apply(fn, recurse)
        for name, value in self._buffers.items():
            old = before[name]
            if value is not None and old is not None and value.is_floating_point() and value.dtype not in EXACT:
                self._buffers[name] = old.to(value.device, torch.float32)
        return self


def without_autocast(function: Callable[Given, Result], *arguments: Given.args, **settings: Given.kwargs) -> Result:
    """``function(*arguments, **settings)`` with autocast off, on whatever device it is on.

    Who calls it asks first whether it is on, by `autocast_is_on`: to turn it off takes as long as several operations.
    """
    device = next((kind for kind in AUTOCASTING if torch.is_autocast_enabled(kind)), None)
    if device is None:
        return function(*arguments, **settings)
    with torch.autocast(device, enabled=False):
        return without_autocast(function, *arguments, **settings)


def exact_product(one: Tensor, other: Tensor) -> Tensor:
    """``one @ other``, with or without autocast."""
    return without_autocast(torch.matmul, one, other) if autocast_is_on() else one @ other


def at_least_float32(tensor: Tensor) -> Tensor:
    """``tensor``, in float32 if it is less precise."""
    return tensor if tensor.dtype in EXACT else tensor.float()


def in_type_of(given: Tensor, *tensors: Tensor) -> Any:
    """``tensors`` (one or several) in the type of ``given``, but in float32 at least."""
    dtype = at_least_float32(given).dtype
    return tensors[0].to(dtype) if len(tensors) == 1 else tuple(tensor.to(dtype) for tensor in tensors)
