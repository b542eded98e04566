"""Dynamic hindsight experience replay (Fang et al., ICLR 2019): goals that moved as another episode's did."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.training.episode_replay import EpisodeReplayBuffer, episode_storage

NEXT_ACHIEVED, NEXT_DESIRED = ("next", keys.ACHIEVED_GOAL), ("next", keys.DESIRED_GOAL)


class Matches(NamedTuple):
    """Moments at which one episode was where another's goal was at some moment, M of the first kind."""

    achieved: Tensor
    """``(M,)`` int64 flat index (episode · T + step) of each achieved point that has a partner."""
    desired: Tensor
    """``(D,)`` int64 flat index of each desired point of a failed episode, by cell and then by episode."""
    first: Tensor
    """``(M,)``: where in ``desired`` an achieved point's cell begins."""
    skipped: Tensor
    """``(M,)``: where in the cell the points of its own episode begin, which are no partners."""
    own: Tensor
    """``(M,)``: how many these are."""
    partners: Tensor
    """``(M,)``: how many others there are, at least 1."""
    cell_start: Tensor
    """``(C + 1,)``: ``achieved`` is ordered by cell; where each cell begins, and its length."""

    def partner(self, match: Tensor, number: Tensor) -> Tensor:
        """Flat index of the desired point ``number`` (R,), from 0 on, of the achieved points ``match`` (R,)."""
        skip = number >= self.skipped[match]
        return self.desired[self.first[match] + number + skip * self.own[match]]


def cells_of(points: Tensor, size: float) -> Tensor:
    """Number of the cube of side ``size`` [m] that holds each of ``points`` (*B, 3), within 10 km: ``(*B,)`` int64."""
    index = torch.round(points.to(torch.float64) / size).long() + 2**20
    return (index[..., 0] << 42) | (index[..., 1] << 21) | index[..., 2]


def match_goals(achieved: Tensor, desired: Tensor, failed: Tensor, *, cell: float = 0.01) -> Matches:
    """Pairs (episode i, step p), (failed episode j ≠ i, step q) whose achieved and desired points share a cell.

    Args:
        achieved: ``(E, T, 3)`` what each episode achieved after each step [m, world].
        desired: ``(E, T, 3)`` its goal then [m, world].
        failed: ``(E,)`` bool: never at its own goal.
        cell: side of a cell [m].
    """
    count, length = achieved.shape[:2]
    episode = torch.arange(count).repeat_interleave(length)
    both, number = torch.cat([cells_of(achieved, cell), cells_of(desired, cell)]).flatten().unique(return_inverse=True)
    at, wanted = number[: count * length], number[count * length :]
    eligible = failed.repeat_interleave(length).nonzero().squeeze(-1)
    key, order = (wanted[eligible] * count + episode[eligible]).sort(stable=True)
    points = eligible[order]
    first, last = torch.searchsorted(key, at * count), torch.searchsorted(key, (at + 1) * count)
    own = at * count + episode
    own_first, own_last = torch.searchsorted(key, own), torch.searchsorted(key, own, right=True)
    partners = (last - first) - (own_last - own_first)
    rows = (partners > 0).nonzero().squeeze(-1)
    rows = rows[at[rows].argsort(stable=True)]
    sizes = torch.bincount(at[rows], minlength=len(both))
    sizes = sizes[sizes > 0]
    starts = torch.nn.functional.pad(sizes.cumsum(0), (1, 0))
    return Matches(
        rows, points, first[rows], (own_first - first)[rows], (own_last - own_first)[rows], partners[rows], starts
    )


class DynamicHindsightReplayBuffer(EpisodeReplayBuffer):
    """Whole episodes of one length, of which part of a sample is replayed under moving goals of other episodes.

    Where episode i was after step p in the 1 cm cell in which the goal of a failed episode j was after its step q, the
    transition p - s of i is replayed with the goals of j at q - s, s uniform in 0 … min(p, q), and its reward is
    computed again. Such transitions are the first ``ratio`` · (1 - recent success) of a sample; the rest is as it
    happened. The cell is drawn first, all cells alike, then the two points in it: the authors' table keeps one pair a
    cell, the latest.
    """

    def __init__(
        self,
        reward_fn: Callable[[TensorDictBase], Tensor],
        *,
        capacity: int,
        length: int,
        batch_size: int,
        ratio: float = 0.8,
        cell: float = 0.01,
        recent: int = 100,
        generator: torch.Generator | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        """An empty buffer.

        Args:
            reward_fn: maps transitions with the goals already replaced to rewards ``(B, 1)``.
            capacity: transitions kept, at least one episode; rounded down to whole episodes.
            length: transitions in an episode.
            batch_size: transitions of a sample.
            ratio: greatest share of a sample that is given other goals.
            cell: side of the cells in which points are matched [m].
            recent: episodes over which success is counted.
            generator: source of every draw.
            device: of the samples; what is stored stays on the CPU.

        Raises:
            InputError: ``capacity`` holds no episode, or a number is out of its range.
        """
        check_number("ratio", ratio, minimum=0.0, maximum=1.0)
        check_number("cell", cell, minimum=1e-6)
        check_number("recent", recent, minimum=1, integer=True)
        super().__init__(storage=episode_storage(capacity, length), batch_size=batch_size)
        self.reward_fn, self.length, self.ratio, self.cell = reward_fn, length, ratio, cell
        self.draw, self._recent, self._count = generator, recent, batch_size
        self.device = torch.device(device)
        self._history = torch.zeros(0, dtype=torch.bool)
        self._matches: Matches | None = None

    def extend(self, data: Any, **settings: Any) -> Any:
        """Add whole episodes, as `EpisodeReplayBuffer`, with ``next/reward``, 0 at the goal and negative elsewhere."""
        added = super().extend(data, **settings)
        reward: Tensor = data.get(("next", "reward"))
        succeeded = (reward.reshape(-1, self.length) >= 0.0).any(-1)
        self._history = torch.cat([self._history, succeeded])[-self._recent :]
        self._matches = None
        return added

    @property
    def recent_success(self) -> float:
        """Share of the latest episodes that were at their goal; 0 before there are any."""
        return float(self._history.double().mean()) if len(self._history) else 0.0

    @property
    def matches(self) -> Matches:
        """All pairs in what is stored now."""
        if self._matches is None:
            stored = self._storage[: len(self)]
            shape = (-1, self.length)
            failed = (stored["next", "reward"].reshape(*shape) < 0.0).all(-1)
            achieved, desired = (stored[key].reshape(*shape, 3) for key in (NEXT_ACHIEVED, NEXT_DESIRED))
            self._matches = match_goals(achieved, desired, failed, cell=self.cell)
        return self._matches

    def sample(self, batch_size: int | None = None, *, success: float | None = None) -> TensorDictBase:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A batch, the transitions with other goals first.

        Args:
            batch_size: transitions; the buffer's own number by default.
            success: recent success, 0 to 1; that of the episodes added by default.
        """
        count = batch_size or self._count
        success = self.recent_success if success is None else success
        relabelled = int(self.ratio * count * (1.0 - success)) if len(self.matches.achieved) else 0
        plain = self._integers(torch.full((count - relabelled,), len(self)))
        moved, goals = self.draw_pairs(relabelled)
        batch: TensorDictBase = self._storage[torch.cat([moved, plain])].clone()
        if relabelled:
            source = self._storage[goals]
            for key in (keys.DESIRED_GOAL, NEXT_DESIRED):
                batch[key][:relabelled] = source[key]
            batch["next", "reward"] = self.reward_fn(batch)
        return batch if self.device.type == "cpu" else batch.to(self.device)

    def draw_pairs(self, count: int) -> tuple[Tensor, Tensor]:
        """Flat indices ``(count,)`` of transitions, and of those whose goals they are given."""
        if not count:
            none = torch.zeros(0, dtype=torch.int64)
            return none, none
        found = self.matches
        cell = self._integers(torch.full((count,), len(found.cell_start) - 1))
        size = found.cell_start[cell + 1] - found.cell_start[cell]
        match = found.cell_start[cell] + self._integers(size)
        achieved, desired = found.achieved[match], found.partner(match, self._integers(found.partners[match]))
        earlier = self._integers(torch.minimum(achieved % self.length, desired % self.length) + 1)
        return achieved - earlier, desired - earlier

    def _integers(self, bound: Tensor) -> Tensor:
        """Uniform draws from 0 … bound - 1, each of its own bound (R,) int64."""
        share = torch.rand(bound.shape, generator=self.draw, dtype=torch.float64)
        return torch.minimum((share * bound).long(), bound - 1)

    def tensors(self) -> dict[str, Tensor]:
        """What is stored, by flat names, in the order of storage, and the recent successes."""
        return super().tensors() | {"recent": self._history}

    def restore(self, tensors: dict[str, Tensor], cursor: int) -> None:
        """Fill an empty buffer with what `tensors` gave, the next episode going to ``cursor``."""
        transitions = {name: value for name, value in tensors.items() if name != "recent"}
        super().restore(transitions, cursor)
        self._history, self._matches = tensors["recent"], None
