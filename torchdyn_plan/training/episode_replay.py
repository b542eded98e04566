"""Common code of replay buffers of whole episodes: filling, writing to a checkpoint, restoring."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchdyn_plan.errors import InputError


def episode_storage(capacity: int, length: int, device: torch.device | str = "cpu") -> LazyTensorStorage:
    """Storage of ``capacity`` transitions, rounded down to whole episodes of ``length``; `InputError` if none fits."""
    if capacity < length:
        raise InputError(f"capacity must hold an episode of {length} transitions, got {capacity}")
    return LazyTensorStorage(capacity - capacity % length, device=device)


class EpisodeReplayBuffer(ReplayBuffer):
    """A replay buffer of concatenated episodes of equal length."""

    length: int
    """Transitions in an episode."""

    def extend(self, data: Any, **settings: Any) -> Any:
        """Add whole episodes, batch ``(*N, length)``, or concatenated, ``(N * length,)``.

        Raises:
            InputError: the batch has another length, or an episode does not end where it should.
        """
        batch = tuple(data.batch_size)
        if len(batch) > 1 and batch[-1] != self.length:
            raise InputError(f"episodes must have {self.length} transitions, got a batch of {batch}")
        if not batch or batch[-1] % self.length:
            raise InputError(f"transitions must come as whole episodes of {self.length}, got a batch of {batch}")
        rows = data.reshape(-1)
        done = rows.get(("next", "done"), None)
        if done is not None and not _ends_each(done.reshape(-1, self.length)):
            raise InputError(f"transitions must come as whole episodes of {self.length}, got some that end elsewhere")
        return super().extend(rows, **settings)

    def add(self, data: Any) -> int:
        """Refused: a single transition is not a whole episode."""
        raise InputError(f"transitions must come as whole episodes of {self.length}, got one: use extend")

    def tensors(self) -> dict[str, Tensor]:
        """The stored tensors, by flat names, in the order of storage."""
        stored = self._storage[: len(self)]
        return {".".join(key) if isinstance(key, tuple) else key: value for key, value in stored.items(True, True)}

    def restore(self, tensors: dict[str, Tensor], cursor: int) -> None:
        """Fill an empty buffer with the result of `tensors`; the next episode goes to ``cursor``."""
        count = len(next(iter(tensors.values())))
        entries = TensorDict({}, batch_size=[count])
        for name, value in tensors.items():
            entries.set(tuple(name.split(".")), value)
        super().extend(entries)
        writer: Any = self._writer
        writer._cursor = cursor

    @property
    def cursor(self) -> int:
        """Position of the next episode."""
        writer: Any = self._writer
        return int(writer._cursor)


def _ends_each(done: Tensor) -> bool:
    """Whether ``done`` (N, T) is true at the end of every row, and nowhere else."""
    return bool(done[:, -1].all()) and not bool(done[:, :-1].any())
