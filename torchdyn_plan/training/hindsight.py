"""Hindsight experience replay over concatenated whole episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import HERReplayBuffer
from torchrl.data.replay_buffers.storages import Storage

from torchdyn_plan import keys
from torchdyn_plan.training.episode_replay import EpisodeReplayBuffer, episode_storage

NEXT_ACHIEVED = ("next", keys.ACHIEVED_GOAL)


# TorchRL itself uses two names for the argument of `extend`.
class HindsightReplayBuffer(EpisodeReplayBuffer, HERReplayBuffer):  # pyright: ignore[reportIncompatibleMethodOverride]
    """TorchRL's `HERReplayBuffer` for episodes of equal length, strategy *future*.

    Replaces two parts of the upstream class: the key of its cache of episode ends (it contains a tensor, and comparing
    two of them raises once the storage is full), and the ends themselves (after wrapping around they miss the last one,
    so that a goal may come from another episode). Here every episode has ``length`` transitions and the capacity is a
    multiple of it, so that the ends follow by arithmetic. After relabelling, ``next`` has the goal of the transition,
    because a goal that changed in between should not be learned from it.
    """

    def __init__(
        self,
        reward_fn: Callable[[TensorDictBase], Tensor],
        *,
        capacity: int,
        length: int,
        batch_size: int,
        her_ratio: float = 0.8,
        device: torch.device | str = "cpu",
    ) -> None:
        """An empty buffer.

        Args:
            reward_fn: maps transitions with the goal already replaced to rewards ``(B, 1)``.
            capacity: transitions kept, at least one episode; rounded down to whole episodes.
            length: transitions in an episode.
            batch_size: transitions of a sample.
            her_ratio: share of a sample that is relabelled, its first rows.
            device: where transitions are kept and sampled.

        Raises:
            InputError: ``capacity`` holds no episode.
        """
        super().__init__(
            reward_fn,
            her_ratio=her_ratio,
            strategy="future",
            achieved_goal_key=NEXT_ACHIEVED,
            storage=episode_storage(capacity, length, device),
            batch_size=batch_size,
        )
        self.length = length

    def _get_episode_ends(self, storage: Storage) -> Tensor:
        return torch.arange(self.length - 1, len(self), self.length)

    def _get_episode_range(self, idx: Tensor, episode_ends: Tensor) -> tuple[Tensor, Tensor]:
        start = idx - idx % self.length
        return start, start + (self.length - 1)

    def _sample_goal_indices(self, her_idx: Tensor, ep_starts: Tensor, ep_ends: Tensor, storage_len: int) -> Tensor:
        span = (ep_ends - her_idx + 1).float()
        return her_idx + (torch.rand(len(her_idx)) * span).long().clamp(max=ep_ends - her_idx)

    def _sample(self, batch_size: int) -> tuple[Any, dict[str, Any]]:
        data, info = super()._sample(batch_size)
        data.set(("next", keys.DESIRED_GOAL), data.get(keys.DESIRED_GOAL))
        return data, info
