"""What replay buffers of whole episodes share: how they are filled, written to a checkpoint and restored."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchdyn_plan.errors import InputError


def episode_storage(capacity: int, length: int, device: torch.device | str = "cpu") -> LazyTensorStorage:
    """Storage of ``capacity`` transitions, rounded down to whole episodes of ``length``; `InputError` if none fits."""
    if capacity < length:
        raise InputError(f"capacity must hold an episode of {length} transitions, got {capacity}")
    return LazyTensorStorage(capacity - capacity % length, device=device)


class EpisodeReplayBuffer(ReplayBuffer):
    """A replay buffer of episodes of one length, laid end to end."""

    length: int
    """Transitions in an episode."""

    def extend_episodes(self, episodes: TensorDictBase) -> None:
        """Add whole ``episodes``, batch ``(*N, length)``."""
        if episodes.batch_size[-1] != self.length:
            raise InputError(f"episodes must have {self.length} transitions, got {episodes.batch_size[-1]}")
        self.extend(episodes.reshape(-1))

    def tensors(self) -> dict[str, Tensor]:
        """What is stored, by flat names, in the order of storage."""
        stored = self._storage[: len(self)]
        return {".".join(key) if isinstance(key, tuple) else key: value for key, value in stored.items(True, True)}

    def restore(self, tensors: dict[str, Tensor], cursor: int) -> None:
        """Fill an empty buffer with what `tensors` gave, the next episode going to ``cursor``."""
        count = len(next(iter(tensors.values())))
        entries = TensorDict({}, batch_size=[count])
        for name, value in tensors.items():
            entries.set(tuple(name.split(".")), value)
        self.extend(entries)
        writer: Any = self._writer
        writer._cursor = cursor

    @property
    def cursor(self) -> int:
        """Where the next episode goes."""
        writer: Any = self._writer
        return int(writer._cursor)
