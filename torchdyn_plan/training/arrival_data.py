"""Recorded arrivals of a static planner: states, goals and the steps between them."""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.checks import POSE_SIZE, check_finite, check_points, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.training.shards import read_shards


class Arrivals(NamedTuple):
    """Samples of runs of a static planner."""

    robot_state: Tensor
    """(n, S), the input of the ETA network."""
    goal: Tensor
    """(n, 3) [m, world]; (n, 7) for poses, like ``goal_pose``."""
    arrival: Tensor
    """(n,) int64 control steps until the goal was reached, -1 for never."""
    nearest: Tensor
    """(n,) int64 control steps until the tool was nearest to the goal."""
    run: Tensor
    """(n,) int64: samples with the same number come from the same run."""

    def take(self, rows: Tensor) -> "Arrivals":
        """The samples ``rows`` (M,)."""
        return Arrivals(*(tensor[rows] for tensor in self))


def load_arrivals(folder: Path, *, state_size: int | None = None) -> Arrivals:
    """All ``arrivals-*.safetensors`` of ``folder``, concatenated.

    Raises:
        InputError: there is none, one is broken, or robot states do not have ``state_size`` entries, if given.
    """
    shards = read_shards(folder, "arrivals", Arrivals._fields)
    data = Arrivals(*(torch.cat([shard[name] for shard in shards]) for name in Arrivals._fields))
    check_points("goal", data.goal[..., :3] if data.goal.shape[-1] == POSE_SIZE else data.goal)
    for name, least in (("arrival", -1), ("nearest", 0), ("run", None)):
        values = getattr(data, name)
        if values.dtype != torch.int64 or (least is not None and bool((values < least).any())):
            upwards = "" if least is None else f" from {least} upwards"
            raise InputError(f"{name} of the arrivals in {str(folder)!r} must be whole numbers{upwards}")
    if state_size is not None:
        check_trailing_shape("robot_state of the arrivals", data.robot_state, state_size)
    for name, tensor in zip(Arrivals._fields, data, strict=True):
        if len(tensor) != len(data.run):
            raise InputError(f"arrivals in {str(folder)!r} have {len(tensor)} rows of {name}, {len(data.run)} of run")
        check_finite(f"{name} of the arrivals in {str(folder)!r}", tensor)
    return data


def split_groups(group: Tensor, seed: int, *, share: float = 0.1) -> tuple[Tensor, Tensor]:
    """Training and held-out rows, split by whole groups: int64 indices of ``group``, ascending.

    Args:
        group: ``(n,)`` int64: rows with the same number stay together.
        seed: selects the held-out groups.
        share: share of held-out groups, at least one group.
    """
    names, member = group.unique(return_inverse=True)
    if len(names) < 2:
        raise InputError(f"needs at least 2 episodes or runs, one of them to hold out; got {len(names)}")
    order = torch.randperm(len(names), generator=torch.Generator().manual_seed(seed))
    held = torch.zeros(len(names), dtype=torch.bool)
    held[order[: max(1, round(share * len(names)))]] = True
    chosen = held[member]
    return (~chosen).nonzero().squeeze(-1), chosen.nonzero().squeeze(-1)
