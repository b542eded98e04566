"""Work for some rows of a batch only."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.func import debug_unwrap

from torchdyn_plan.checks import hides_values


def any_row(mask: Tensor) -> bool:
    """Whether ``mask`` is true anywhere, so that work for no rows can be skipped; always true while compiling."""
    return torch.compiler.is_compiling() or bool(debug_unwrap(mask).any())


def where_rows(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """``new`` (*B, …) in the rows of ``mask`` (*B,), ``old`` in the others."""
    return torch.where(mask[(..., *[None] * (new.ndim - mask.ndim))], new, old)


def apply_to_rows(
    function: Callable[..., Sequence[Tensor]],
    mask: Tensor,
    inputs: Sequence[Tensor],
    outputs: Sequence[Tensor],
    *,
    chunk: int | None = None,
) -> tuple[Tensor, ...]:
    """Replace ``outputs`` by ``function(*inputs)`` in the rows where ``mask`` is true; the others keep their values.

    Matrix products may differ in the last bit with the number of rows. With ``chunk`` the function always sees exactly
    that many rows (the last block is padded by repeating a row), so that a row's result depends on that row only. While
    compiling and under ``torch.vmap``, where the number of rows must not depend on data, the function sees all rows.

    Args:
        function: maps tensors with one leading batch dimension, ``(R, …)`` each, to as many tensors as ``outputs``.
            It is not called if no row is selected.
        mask: ``(*B,)`` bool.
        inputs: what the function reads, ``(*B, …)`` each.
        outputs: old values, ``(*B, …)`` each; left untouched.
        chunk: rows per call; None for one call with all selected rows.

    Returns:
        New tensors of the shapes and types of ``outputs``.
    """
    if hides_values(mask):
        made = function(*(_flat(value, mask.ndim) for value in inputs))
        pairs = zip(made, outputs, strict=True)
        return tuple(where_rows(mask, new.to(old.dtype).reshape(old.shape), old) for new, old in pairs)
    rows = mask.reshape(-1).nonzero().squeeze(-1)
    count = rows.numel()
    if count == 0:
        return tuple(outputs)
    flat = [_flat(value, mask.ndim) for value in inputs]
    if count == mask.numel() and chunk is None:
        pairs = zip(function(*flat), outputs, strict=True)
        return tuple(new.to(old.dtype).reshape(old.shape) for new, old in pairs)
    if chunk is not None:
        padding = rows[-1:].expand(-count % chunk)
        rows = torch.cat([rows, padding])
    blocks = [function(*(value[block] for value in flat)) for block in rows.split(chunk or count)]
    merged = []
    for old, *new in zip(outputs, *blocks, strict=True):
        values = torch.cat(new)[:count].to(old.dtype)
        merged.append(_flat(old, mask.ndim).index_copy(0, rows[:count], values).reshape(old.shape))
    return tuple(merged)


def _flat(value: Tensor, batch_ndim: int) -> Tensor:
    """View ``(*B, …)`` as ``(R, …)``."""
    if batch_ndim == 1:
        return value
    return value.unsqueeze(0) if batch_ndim == 0 else value.flatten(0, batch_ndim - 1)
