"""Interface of models that predict when, and whether, a robot arrives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.distributions import Arrival
from torchdyn_plan.precision import in_type_of


class ArrivalQuery(Protocol):
    """Arrivals of robots in fixed states; a goal search calls it with goals."""

    def __call__(self, goal: Tensor, *, estimator: str = "mode") -> Arrival:
        """Arrivals ``(*B, K)`` at goals ``(*B, K, D)`` [m, world]."""
        ...


class ArrivalModel(nn.Module, ABC):
    """Predicts the time a static planner needs to a goal, such as `torchdyn_plan.nets.ETANetwork`."""

    @abstractmethod
    def arrival(self, robot_state: Tensor, goal: Tensor, *, estimator: str = "mode") -> Arrival:
        """Arrival ``(*B, K)`` at goals (*B, K, D) [m, world] from robot states (*B, 1, S).

        ``estimator`` selects how a distribution over time is reduced to one number; a deterministic model ignores it.
        """

    def from_state(self, robot_state: Tensor) -> ArrivalQuery:
        """Arrivals from ``robot_state`` (*B, S); work that depends on the state only is done once, if possible."""
        return partial(self.arrival, robot_state.unsqueeze(-2))

    def for_inference(self) -> ArrivalModel:
        """The same function in as few operations as possible; by default the model itself."""
        return self


class FunctionArrival(ArrivalModel):
    """A function as an arrival model."""

    def __init__(self, function: Callable[[Tensor, Tensor], Any]) -> None:
        """Wrap ``function``, from robot states (*B, 1, S) and goals (*B, K, D) to an `Arrival` or to steps."""
        super().__init__()
        self.function = function

    @classmethod
    def wrap(cls, model: Any) -> ArrivalModel:
        """``model`` if it is an arrival model, else the function that it must be; raises `InputError`."""
        if isinstance(model, ArrivalModel):
            return model
        if not callable(model):
            raise InputError(f"eta must be an ArrivalModel or a function of robot state and goal, got {model!r}")
        return cls(model)

    def arrival(self, robot_state: Tensor, goal: Tensor, *, estimator: str = "mode") -> Arrival:
        """The function's result, with steps in the goals' type; infinite steps are *never*."""
        found = self.function(robot_state, goal)
        return found if isinstance(found, Arrival) else Arrival(in_type_of(goal, found), torch.isinf(found))
