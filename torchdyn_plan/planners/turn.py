"""How a tool is to be turned where it meets its target: a part of planners whose goals are poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.quaternions import quat_multiply


class Turn(Protocol):
    """Says how the tool is to be turned at each place of a forecast."""

    @property
    def in_keys(self) -> Sequence[Any]:
        """Entries that it reads of the observation, beside where the target is."""
        ...

    def __call__(self, path: Tensor, target_pos: Tensor, /, *seen: Tensor) -> Tensor:
        """Quaternions wxyz ``(*B, F, 4)`` of the tool in the world; zeros where it may be turned as it is.

        Args:
            path: ``(*B, F, 3)`` where the target is expected in 1 … F control steps [m, world].
            target_pos: ``(*B, 3)`` where it is now.
            seen: the entries ``in_keys``, ``(*B, …)`` each.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class WithTarget:
    """The tool is turned with the target, which keeps turned as it is: ``target_quat`` is read.

    The default looks down on a target that lies flat: the tool's z axis is against the target's, and the x axes agree.
    """

    in_keys: ClassVar[tuple[str, ...]] = (keys.TARGET_QUAT,)

    quat: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)
    """How the tool is turned in the target's frame, quaternion wxyz."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "quat", tuple(self.quat))
        if len(self.quat) != 4 or not any(self.quat):
            raise InputError(f"quat must be a quaternion wxyz other than zero, got {self.quat!r}")
        for value in self.quat:
            check_number("quat", value)

    def __call__(self, path: Tensor, target_pos: Tensor, *seen: Tensor) -> Tensor:
        """As of `Turn`."""
        (target_quat,) = seen
        check_trailing_shape(keys.TARGET_QUAT, target_quat, 4)
        quat = quat_multiply(target_quat, target_quat.new_tensor(self.quat).expand_as(target_quat))
        return quat.unsqueeze(-2).expand(*path.shape[:-1], 4)
