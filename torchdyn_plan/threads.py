"""How torch computes: on how many threads, and by which products of matrices."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import torch


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Torch on ``count`` threads; afterwards on as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def one_thread() -> AbstractContextManager[None]:
    """Torch on one thread: networks this small are fastest on one, which leaves the cores to the simulation."""
    return torch_threads(1)


@contextmanager
def quick_products() -> Iterator[None]:
    """Products of float32 matrices by oneDNN on a CPU: twice as fast on AVX-512, and about as exact.

    On processors that multiply bfloat16 by themselves (AMX), and on CUDA, some products may be rounded to fewer digits:
    for learning alone.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
