"""Windows of a target's recorded path: the history that a forecaster reads and the future that it should emit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import check_finite, check_number, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.files import short_path
from torchdyn_plan.training.lines import Lines
from torchdyn_plan.training.shards import read_shards


class Paths(NamedTuple):
    """Recorded paths of E episodes, concatenated."""

    positions: Tensor
    """(T, 3) [m, world], one per control step."""
    start: Tensor
    """(E,) int64 index of each episode's position at its reset."""
    length: Tensor
    """(E,) int64 samples of each episode."""
    lost: Tensor
    """(E,) bool: the target is lost at the last sample and stays there; ``pocketed`` in the files."""


class Windows(NamedTuple):
    """A batch of windows."""

    history: Tensor
    """(*B, H, 3) [m, world], padded at the front with the first sample."""
    history_length: Tensor
    """(*B,) int64 number of rows of the history that are not padding."""
    future: Tensor
    """(*B, F, 3) [m, world], or on the unreflected line if requested."""
    recorded: Tensor
    """(*B, F) bool: false after the target was lost, where the future repeats its last position."""
    lost: Tensor
    """(*B,) bool: the target is lost within the window."""
    moving: Tensor
    """(*B,) bool: the target moves at the window's present."""
    covariance: Tensor | None = None
    """(*B, 2, 2) present covariance of position and velocity, for targets seen by a track [m², m²/s; m²/s, m²/s²]."""

    @classmethod
    def joined(cls, parts: Sequence[Windows]) -> Windows:
        """Concatenate them; either all or none were seen by a track."""
        joined: list[Any] = [None if values[0] is None else torch.cat(values) for values in zip(*parts, strict=True)]
        return cls(*joined)

    @property
    def seen(self) -> tuple[Tensor, ...]:
        """The forecaster's inputs."""
        return (self.history,) if self.covariance is None else (self.history, self.covariance)

    def doubt(self, control_step: float) -> Tensor:
        """Standard deviation (*B, F) of the future along each axis, from the track's present covariance [m]."""
        if self.covariance is None:
            return torch.zeros_like(self.future[..., 0])
        time = control_step * torch.arange(1.0, self.future.shape[-2] + 1.0)
        place, both, speed = (self.covariance[..., i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
        return (place + 2.0 * time * both + time.square() * speed).clamp_min(0.0).sqrt()


@dataclass(frozen=True, kw_only=True)
class WindowConfig:
    """How windows are drawn from paths."""

    history: int = 24
    """Number H of positions up to the present."""
    horizon: int = 300
    """Number F of positions after it."""
    first_step: int = 13
    """Earliest present: the step of the first plan."""
    early_share: float = 0.2
    """Share of windows whose present lies between ``first_step`` and H, so that their history is padded."""
    shortened_share: float = 0.2
    """Share of all windows whose history is padded as if the episode had just started."""
    still_speed: float = 2e-4
    """Speed below which a target counts as still [m a step]."""

    def __post_init__(self) -> None:
        for name in ("history", "horizon"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        check_number("first_step", self.first_step, minimum=0, integer=True)
        for name in ("early_share", "shortened_share"):
            check_number(name, getattr(self, name), minimum=0.0, maximum=1.0)
        check_number("still_speed", self.still_speed, minimum=0.0)


def load_paths(folder: Path) -> Paths:
    """All ``paths-*.safetensors`` of ``folder`` as one; raises `InputError` if there is none or one is broken."""
    parts: list[Paths] = []
    offset = 0
    for shard in read_shards(folder, "paths", ("positions", "start", "length", "pocketed")):
        _check_paths(folder, shard)
        parts.append(Paths(shard["positions"], shard["start"] + offset, shard["length"], shard["pocketed"]))
        offset += len(shard["positions"])
    return Paths(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))


def _check_paths(folder: Path, shard: dict[str, Tensor]) -> None:
    """Raise `InputError` unless the paths of a shard are concatenated without gaps, and finite."""
    where = f"of the paths in {short_path(Path(folder))}"
    check_trailing_shape(f"positions {where}", shard["positions"], 3)
    check_finite(f"positions {where}", shard["positions"])
    start, length, lost = (shard[name] for name in ("start", "length", "pocketed"))
    if not (start.shape == length.shape == lost.shape == (len(length),)):
        shapes = [tuple(shard[name].shape) for name in ("start", "length", "pocketed")]
        raise InputError(f"start, length and pocketed {where} must have shape (E,), got {shapes}")
    whole = start.dtype == length.dtype == torch.int64 and lost.dtype == torch.bool and bool((length >= 1).all())
    if not whole or not torch.equal(start, length.cumsum(0) - length) or int(length.sum()) != len(shard["positions"]):
        raise InputError(f"start and length {where} do not lay the paths end to end")


def last_useful_step(paths: Paths, config: WindowConfig) -> Tensor:
    """Latest present of a window, (E,) int64: its future is recorded, and the target moved until shortly before."""
    step = torch.nn.functional.pad(paths.positions.diff(dim=0).norm(dim=-1), (1, 0))
    episode = torch.repeat_interleave(torch.arange(len(paths.length)), paths.length)
    index = torch.arange(len(paths.positions)) - paths.start[episode]
    moved = torch.where((step > config.still_speed) & (index > 0), index, 0)
    last_moved = torch.zeros_like(paths.length).scatter_reduce(0, episode, moved, "amax")
    recorded = torch.where(paths.lost, paths.length - 2, paths.length - 1 - config.horizon)
    return torch.minimum(recorded, last_moved + config.history)


def draw_windows(
    paths: Paths,
    last_step: Tensor,
    episodes: Tensor,
    config: WindowConfig,
    generator: torch.Generator,
    *,
    lines: Lines | None = None,
) -> Windows:
    """One random window of each of ``episodes`` (M,), whose presents may run to ``last_step`` (E,)."""
    shape = episodes.shape
    chance, place, kind, cut = torch.rand((4, *shape), generator=generator)
    last = last_step[episodes]
    # Squared, so that presents are denser while targets are still fast.
    latest = torch.where(chance < config.early_share, last.clamp(max=config.history), last)
    present = config.first_step + (place.square() * (latest - config.first_step + 1)).long()
    shortest = min(config.first_step, config.history)
    shortened = shortest + (cut * (config.history - shortest + 1)).long()
    seen = torch.where(kind < config.shortened_share, shortened, config.history)
    return cut_windows(paths, episodes, present, torch.minimum(seen, present), config, lines=lines)


def cut_windows(
    paths: Paths, episodes: Tensor, present: Tensor, seen: Tensor, config: WindowConfig, *, lines: Lines | None = None
) -> Windows:
    """Windows at steps ``present`` (M,) of ``episodes`` (M,); ``seen`` (M,) rows of the history are not padding.

    With ``lines`` the futures are unreflected, continued from the stretch of table that the target is on.
    """
    last = paths.length[episodes] - 1
    first, now = paths.start[episodes], paths.start[episodes] + present
    behind = torch.arange(1 - config.history, 1) + present.unsqueeze(-1)
    oldest = (present - seen).unsqueeze(-1)
    history = paths.positions[first.unsqueeze(-1) + torch.maximum(behind, oldest)]
    ahead = torch.arange(1, config.horizon + 1) + present.unsqueeze(-1)
    recorded = ahead <= last.unsqueeze(-1)
    index = first.unsqueeze(-1) + torch.minimum(ahead, last.unsqueeze(-1))
    if lines is None:
        future = paths.positions[index]
    else:
        future = lines.track[index]
        future[..., :2] = (future[..., :2] - lines.shift[now].unsqueeze(-2)) * lines.side[now].unsqueeze(-2)
    moving = (history[..., -1, :] - history[..., -2, :]).norm(dim=-1) > config.still_speed
    lost = paths.lost[episodes] & (last <= present + config.horizon)
    return Windows(history, seen.clamp(max=config.history), future, recorded, lost, moving)
