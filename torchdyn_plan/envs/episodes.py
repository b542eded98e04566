"""Episodes by number: how one starts is a pure function of its split, its seed and its index."""

from __future__ import annotations

import secrets

import numpy as np
import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice

FINAL = "final"
"""The split that a release plays once, and nobody before."""
SPLITS = {"test": 0, "dev": 1, "train": 2, FINAL: 3}
"""Tuning sees ``dev`` only, networks learn from ``train``, and results are reported on ``test``."""


def somewhere() -> int:
    """Number of an episode far into a series, different at every call, with a million unused numbers after it."""
    return secrets.randbits(30) << 20


def episode_random(split: str, seed: int, episode: int, *stream: int) -> np.random.Generator:
    """The random generator of an episode; another ``stream`` is for what is drawn beside its start.

    Raises:
        InputError: the split is unknown.
    """
    check_choice("split", split, SPLITS)
    return np.random.default_rng((SPLITS[split], seed, episode, *stream))


def draw_uniform(episodes: Tensor, count: int, *, split: str, seed: int) -> Tensor:
    """``count`` numbers of each of ``episodes`` (M,), uniform within ±1: ``(M, count)`` float64."""
    draws = [episode_random(split, seed, episode).uniform(-1.0, 1.0, count) for episode in episodes.tolist()]
    return torch.from_numpy(np.stack(draws))
