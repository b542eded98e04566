"""Procedural pictures for the scene: wood for the rails, green felt for the cloth."""

import numpy as np


def wood(size: int = 128) -> np.ndarray:
    """Wood grain, ``(size, size, 3)`` uint8: stretched smooth noise around a warm brown."""
    noise = np.random.default_rng(0)
    rows = np.linspace(0, 1, size)[:, None]
    columns = np.linspace(0, 1, size)[None, :]
    wobble = sum(noise.uniform(0.01, 0.04) * np.sin(2 * np.pi * (k * columns + noise.uniform())) for k in (1, 2, 3))
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (9 * (rows + wobble)))
    fibre = noise.normal(size=(size, 1)).repeat(size, 1) * 0.35 + noise.normal(size=(size, size)) * 0.12
    shade = np.clip(0.72 + 0.18 * rings + 0.06 * fibre, 0, 1)
    return (np.array([196, 122, 62]) * shade[..., None]).clip(0, 255).astype(np.uint8)


def felt(size: int = 128) -> np.ndarray:
    """Green felt, ``(size, size, 3)`` uint8."""
    noise = np.random.default_rng(1)
    shade = 1.0 + 0.06 * noise.normal(size=(size, size))
    return (np.array([16, 118, 92]) * shade[..., None]).clip(0, 255).astype(np.uint8)
