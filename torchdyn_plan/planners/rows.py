"""Work for some rows of a batch only."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


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
    that many rows (a row is repeated to fill the last block), so that a row's result depends on that row alone.

    Args:
        function: maps tensors with one leading batch dimension, ``(R, …)`` each, to as many tensors as ``outputs``.
            It is not called when no row is chosen.
        mask: ``(*B,)`` bool.
        inputs: what the function reads, ``(*B, …)`` each.
        outputs: old values, ``(*B, …)`` each; left untouched.
        chunk: rows per call; one call with the chosen rows if None.

    Returns:
        New tensors of the shapes and types of ``outputs``.
    """
    rows = mask.reshape(-1).nonzero().squeeze(-1)
    count = rows.numel()
    if count == 0:
        return tuple(outputs)
    if chunk is not None:
        padding = rows[-1:].expand(-count % chunk)
        rows = torch.cat([rows, padding])
    flat = [_flat(value, mask.ndim) for value in inputs]
    blocks = [function(*(value[block] for value in flat)) for block in rows.split(chunk or count)]
    merged = []
    for old, *new in zip(outputs, *blocks, strict=True):
        values = torch.cat(new)[:count].to(old.dtype)
        merged.append(_flat(old, mask.ndim).index_copy(0, rows[:count], values).reshape(old.shape))
    return tuple(merged)


def _flat(value: Tensor, batch_ndim: int) -> Tensor:
    """View ``(*B, …)`` as ``(R, …)``."""
    return value.reshape(-1, *value.shape[batch_ndim:])
