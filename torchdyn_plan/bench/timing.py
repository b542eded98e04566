"""Durations: how they are sampled, and the figures that a benchmark gives of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch


def sample(
    function: Callable[[], object],
    *,
    device: str = "cpu",
    seconds: float = 0.5,
    least: int = 3,
    before: Callable[[], object] | None = None,
) -> list[float]:
    """Durations [s] of calls of ``function``, after one that is not counted.

    Args:
        function: what is timed.
        device: where it computes; a call ends when the device is done.
        seconds: time after which no further call is made.
        least: calls that are made in any case.
        before: called before each call, and not timed.
    """
    wait = torch.cuda.synchronize if device.startswith("cuda") else _nothing
    prepare = before or _nothing
    durations: list[float] = []
    prepare()
    function()
    wait()
    deadline = time.perf_counter() + seconds
    while len(durations) < least or time.perf_counter() < deadline:
        prepare()
        started = time.perf_counter()
        function()
        wait()
        durations.append(time.perf_counter() - started)
    return durations


def figures(durations: Sequence[float], batch: int) -> dict[str, float]:
    """Median, 95th and 99th percentile of ``durations`` [s] and their mean for one of ``batch`` items [µs]."""
    values = 1e6 * torch.tensor(durations, dtype=torch.float64)
    median, p95, p99 = torch.quantile(values, torch.tensor([0.5, 0.95, 0.99], dtype=torch.float64)).tolist()
    rounded = {"median_us": median, "p95_us": p95, "p99_us": p99, "per_item_us": float(values.mean()) / batch}
    return {name: round(value, 3) for name, value in rounded.items()}


def _nothing() -> None:
    return None
