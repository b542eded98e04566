"""The near part of a forecast, kept between plans."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys

OUTLOOK_NAMES = ("outlook", "outlook_age")


class Outlook(NamedTuple):
    """Where the target is expected."""

    path: Tensor
    """``(*B, T, 3)`` [m, world]: positions from the moment on for which the plan was made."""
    age: Tensor
    """``(*B,)`` int64: control steps since that moment; -1 where there was none yet."""

    def ahead(self, count: int) -> Tensor:
        """Positions now and in 1 … ``count`` - 1 steps, ``(*B, count, 3)``; the last one is repeated beyond the end."""
        ahead = torch.arange(count, device=self.age.device)
        index = (self.age.clamp_min(0).unsqueeze(-1) + ahead).clamp(max=self.path.shape[-2] - 1)
        return self.path.gather(-2, index.unsqueeze(-1).expand(*index.shape, 3))


def recall_outlook(tensordict: TensorDictBase, target_pos: Tensor, step_count: Tensor, length: int) -> Outlook:
    """The outlook of the step before, one step older; rows at step 0, and all without one, see the target at rest."""
    resting = target_pos.unsqueeze(-2).expand(*target_pos.shape[:-1], length, 3)
    none = torch.full_like(step_count, -1)
    plan = tensordict.get(keys.PLAN, None)
    path = None if plan is None else plan.get(OUTLOOK_NAMES[0], None)
    if plan is None or path is None:
        return Outlook(resting, none)
    age, fresh = plan.get(OUTLOOK_NAMES[1]), step_count == 0
    age = torch.where(fresh | (age < 0), none, age + 1)
    return Outlook(torch.where(fresh[..., None, None], resting, path), age)


def cut(forecast: Tensor, target_pos: Tensor, length: int) -> Tensor:
    """The target at ``target_pos`` (*B, 3), then along ``forecast`` (*B, F, 3): ``(*B, length, 3)`` [m, world].

    The last position is repeated where the forecast ends.
    """
    path = torch.cat([target_pos.unsqueeze(-2), forecast], dim=-2)
    ahead = torch.arange(length, device=path.device).clamp(max=path.shape[-2] - 1)
    return path[..., ahead, :]
