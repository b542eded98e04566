"""What a goal search asks: when the robot would be somewhere, from the states that it is in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

if TYPE_CHECKING:
    from torchdyn_plan.nets.eta import Arrival
    from torchdyn_plan.planners.protocol import ArrivalPredictor


class Arrivals:
    """Arrivals of robots in given states, for goals that come later."""

    def __init__(self, predictor: ArrivalPredictor, robot_state: Tensor) -> None:
        """Ask ``predictor`` about robot states ``(*B, S)``."""
        self.predictor, self.robot_state = predictor, robot_state

    def __call__(self, goal: Tensor, **how: Any) -> Arrival:
        """Arrivals ``(*B, K)`` at goals ``(*B, K, 3)`` [m, world]; keywords go to the predictor."""
        return self.predictor.arrival(self.robot_state.unsqueeze(-2), goal, **how)

    def rows(self, index: Tensor) -> Arrivals:
        """The same for rows ``index`` (R,) of states ``(*B, S)`` alone."""
        return Arrivals(self.predictor, self.robot_state.flatten(0, -2)[index])


def arrivals_from(predictor: ArrivalPredictor, robot_state: Tensor) -> Any:
    """`Arrivals` from robot states ``(*B, S)``, or the like that ``predictor`` makes itself with ``from_state``."""
    from_state = getattr(predictor, "from_state", None)
    return Arrivals(predictor, robot_state) if from_state is None else from_state(robot_state)
