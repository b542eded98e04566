"""Your own function as a static planner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.protocol import read
from torchdyn_plan.planners.static.base import StaticPlannerModule


class CallablePlanner(StaticPlannerModule):
    """Static planner made of a function of tensors, by default ``function(robot_state, goal) -> action``."""

    def __init__(
        self, function: Callable[..., Tensor], *, in_keys: Sequence[NestedKey] = (keys.ROBOT_STATE, keys.GOAL)
    ) -> None:
        """Wrap ``function`` (or an `nn.Module`), which is given the values of ``in_keys`` in that order."""
        super().__init__()
        if not callable(function):
            raise InputError(f"function must be callable, got {function!r}")
        self.function = function
        names: list[Any] = [*in_keys]
        self.in_keys = names
        self.out_keys = [keys.ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (*B, A), joint speeds as a fraction of the limit."""
        action = self.function(*(read(tensordict, key, "CallablePlanner") for key in self.in_keys))
        if not isinstance(action, Tensor) or action.shape[:-1] != tensordict.batch_size:
            expected = ", ".join([*map(str, tensordict.batch_size), "A"])
            got = tuple(action.shape) if isinstance(action, Tensor) else type(action).__name__
            raise InputError(f"the function must return actions of shape ({expected}), got {got}")
        tensordict.set(keys.ACTION, action)
        return tensordict


class TensorDictFunction(StaticPlannerModule):
    """Static planner made of a function from tensordict to tensordict."""

    def __init__(self, function: Callable[[TensorDictBase], TensorDictBase]) -> None:
        """Wrap ``function``, which writes ``action`` (*B, A) and declares no other keys."""
        super().__init__()
        self.function = function
        self.in_keys, self.out_keys = [keys.GOAL], [keys.ACTION]

    @classmethod
    def wrap(cls, static: Any) -> TensorDictModuleBase:
        """``static`` if it is a tensordict module, else the function that it must be; raises `InputError`."""
        if isinstance(static, TensorDictModuleBase):
            return static
        if not callable(static):
            raise InputError(f"static must be a planner or a function of a tensordict, got {static!r}")
        function: Any = static
        return cls(function)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Call the function."""
        return self.function(tensordict)
