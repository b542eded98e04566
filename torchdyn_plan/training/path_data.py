"""Recorded paths as training and held-out windows, and the conversion of recordings to shards."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchdyn_plan.errors import InputError
from torchdyn_plan.training.arrival_data import split_groups
from torchdyn_plan.training.lines import Lines
from torchdyn_plan.training.windows import Paths, WindowConfig, Windows, draw_windows, last_useful_step, load_paths

SCORED = 4096
"""Held-out windows of each kind."""


def lay_end_to_end(paths: Tensor, velocity: Tensor, lost: Tensor | None = None) -> dict[str, Tensor]:
    """Paths of equal length as a data shard: each cut where its target is lost, then concatenated.

    Args:
        paths: ``(M, T, 3)`` [m, world], one position per control step.
        velocity: ``(M,)`` of each target, as the task defines it.
        lost: ``(M, T)`` bool: whether a target is lost; None if none is.

    Returns:
        ``positions start length pocketed velocity``, see `torchdyn_plan.tasks.Task.record_paths`.
    """
    count, steps = paths.shape[:2]
    if lost is None:
        lost = torch.zeros(count, steps, dtype=torch.bool)
    ever = lost.any(-1)
    length = torch.where(ever, lost.to(torch.int64).argmax(-1) + 1, steps)
    kept = torch.arange(steps) < length.unsqueeze(-1)
    start = length.cumsum(0) - length
    return {"positions": paths[kept], "start": start, "length": length, "pocketed": ever, "velocity": velocity.float()}


@dataclass(frozen=True)
class PathSamples:
    """Paths split into training and held-out episodes, one in ten held out."""

    paths: Paths
    last: Tensor
    """(E,) int64 latest present of a window."""
    train: Tensor
    """Episodes to fit to."""
    held: Tensor
    """Episodes that are held out."""
    drawing: WindowConfig

    @classmethod
    def load(cls, folder: Path, drawing: WindowConfig, seed: int) -> PathSamples:
        """The paths in ``folder``; ``seed`` decides which episodes are held out. Raises `InputError`."""
        paths = load_paths(folder)
        last = last_useful_step(paths, drawing)
        usable = (last >= drawing.first_step).nonzero().squeeze(-1)
        train, held = (usable[rows] for rows in split_groups(usable, seed))
        return cls(paths, last, train, held, drawing)

    def draw(self, count: int, generator: torch.Generator, *, lines: Lines | None = None) -> Windows:
        """``count`` random training windows, with futures on ``lines`` if given."""
        episodes = self.train[torch.randint(len(self.train), (count,), generator=generator)]
        return draw_windows(self.paths, self.last, episodes, self.drawing, generator, lines=lines)

    def regimes(self, seed: int) -> dict[str, Windows]:
        """Held-out windows by their name in the tables of scores; here a single group."""
        return {"": self.held_windows(seed)}

    def held_windows(self, seed: int) -> Windows:
        """`SCORED` windows with full histories and as many with padded ones, from held-out episodes."""
        draws = torch.Generator().manual_seed(seed)
        full = replace(self.drawing, first_step=self.drawing.history, early_share=0.0, shortened_share=0.0)
        padded = replace(self.drawing, early_share=0.0, shortened_share=1.0)
        scored = []
        for kind in (full, padded):
            episodes = _some(self.held[self.last[self.held] >= kind.first_step], SCORED)
            scored.append(draw_windows(self.paths, self.last, episodes, kind, draws))
        return Windows.joined(scored)


def _some(rows: Tensor, count: int) -> Tensor:
    """``count`` of ``rows``, repeated if there are fewer."""
    if not len(rows):
        raise InputError("no held-out episode is long enough for a window: collect more episodes")
    return rows.repeat(-(-count // len(rows)))[:count]
