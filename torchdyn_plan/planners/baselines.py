"""What a planner for a moving target is measured against: two extremes, and one that knows the future."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_finite, check_number, check_points
from torchdyn_plan.nets.arrival import ArrivalQuery
from torchdyn_plan.nets.forecast import Forecast, ForecastModel
from torchdyn_plan.planners.judging import act, judge_rows
from torchdyn_plan.planners.memory import Remembering
from torchdyn_plan.planners.planner import DynamicPlanner, are_sane
from torchdyn_plan.planners.protocol import StaticPlanner, keys_read, keys_written, read
from torchdyn_plan.planners.search.meeting import NO_CONTEXT, Meeting, SearchContext
from torchdyn_plan.planners.static.callable import TensorDictFunction
from torchdyn_plan.planners.turn import Turn


class TargetPursuit(Remembering):
    """Pursuit: at every step the goal is the target's present position (paper, Section IV-A.1)."""

    def __init__(self, static: StaticPlanner, *, turn: Turn | None = None, scene: str | None = None) -> None:
        """Build on ``static``, a planner for a static goal.

        Args:
            static: as above.
            turn: how the tool is to be turned, for a static planner that reads ``goal_pose``.
            scene: digest of its scene; None if it has none.
        """
        super().__init__()
        self.static, self.scene, self.turn = TensorDictFunction.wrap(static), scene, turn
        goals = (keys.GOAL,) if turn is None else (keys.GOAL, keys.GOAL_POSE)
        self.in_keys = keys_read(self.static, keys.TARGET_POS, *(() if turn is None else turn.in_keys))
        self.out_keys = keys_written(self.static, *goals, keys.ARRIVAL_STEPS)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``goal`` (*B, D) [m, world] and ``arrival_steps`` (*B,), which is 0, and act.

        Rows in which an input is NaN or infinite get action 0.
        """
        target_pos = read(tensordict, keys.TARGET_POS, "TargetPursuit")
        check_points(keys.TARGET_POS, target_pos)
        bad = None
        if not are_sane(tensordict, self.in_keys):
            bad = judge_rows(tensordict, self.in_keys, target_pos.shape[:-1])
        tensordict.set(keys.GOAL, target_pos)
        if self.turn is not None:
            seen = (read(tensordict, key, "TargetPursuit") for key in self.turn.in_keys)
            quat = self.turn(target_pos.unsqueeze(-2), target_pos, *seen).squeeze(-2)
            tensordict.set(keys.GOAL_POSE, torch.cat([target_pos, quat], dim=-1))
        now = torch.zeros(target_pos.shape[:-1], dtype=torch.int64, device=target_pos.device)
        tensordict.set(keys.ARRIVAL_STEPS, now)
        return self.static(tensordict) if bad is None else act(self.static, tensordict, bad)

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """The static planner's, as `Remembering` says."""
        return self.static.empty_memory(like) if isinstance(self.static, Remembering) else {}


@dataclass(frozen=True)
class EndOfForecast:
    """Search that always chooses the last position of the forecast: to go there and wait (paper, III-B.4)."""

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """The end of the forecast, in F steps; ``eta`` is asked once whether the robot can reach it."""
        goal = forecast.path[..., -1, :]
        never = eta(goal.unsqueeze(-2)).never.squeeze(-1)
        steps = torch.full_like(never, forecast.path.shape[-2], dtype=torch.int64)
        return Meeting(goal, steps, torch.zeros_like(never), ~never)


class RecordedFuture(ForecastModel):
    """A forecaster that returns the true future, from a recording of the same episode.

    Entry k of ``target_future`` is where the target was at step k of the episode, with the arm held still.
    """

    in_keys = (keys.TARGET_FUTURE, keys.STEP_COUNT)

    def __init__(self, horizon: int = 300) -> None:
        """Tell ``horizon`` control steps; the target stays where its recording ends."""
        super().__init__()
        check_number("horizon", horizon, minimum=1, integer=True)
        self.horizon = horizon

    def predict(self, *seen: Tensor) -> Forecast:
        """Positions at steps t+1 … t+F, ``(*B, F, D)``, of recordings ``(*B, T, D)`` at steps t (*B,) [m, world]."""
        target_future, step_count = seen
        check_points(keys.TARGET_FUTURE, target_future, _length(target_future))
        check_finite(keys.TARGET_FUTURE, target_future)
        ahead = torch.arange(1, self.horizon + 1, device=target_future.device)
        index = step_count.reshape(*target_future.shape[:-2], 1).long() + ahead
        index = index.clamp(max=target_future.shape[-2] - 1)
        return Forecast(target_future.gather(-2, index.unsqueeze(-1).expand(*index.shape, target_future.shape[-1])))

    def part_settings(self) -> dict[str, Any]:
        """Arguments that make the same model."""
        return {"horizon": self.horizon}


class TrueFuture(ForecastModel):
    """Stands in for a forecaster and tells the truth, whatever has happened: ``true_future``, as long as it is shown.

    An evaluation simulates it from the present state, the robot held still, wherever the target has left what was
    simulated before.
    """

    in_keys = (keys.TRUE_FUTURE,)

    def predict(self, *seen: Tensor) -> Forecast:
        """Positions at steps t+1 … t+F, ``(*B, F, D)`` [m, world], as they are shown."""
        (true_future,) = seen
        check_points(keys.TRUE_FUTURE, true_future, _length(true_future))
        check_finite(keys.TRUE_FUTURE, true_future)
        return Forecast(true_future)

    def part_settings(self) -> dict[str, Any]:
        """None."""
        return {}


def _length(path: Tensor) -> int:
    """Places of ``path`` (*B, T, D), at least one."""
    return path.shape[-2] if path.ndim > 1 else 1


def oracle_trajectory(
    static: StaticPlanner, eta: Any, *, horizon: int = 300, recorded: bool = True, **parts: Any
) -> DynamicPlanner:
    """The paper's planner with the truth as its forecast (paper, IV-A.2).

    Args:
        static: as of `DynamicPlanner`, like ``eta`` and ``parts``.
        eta: predicts how long ``static`` needs to a goal.
        horizon: as far as its search may look into a recording [control steps].
        recorded: the truth is what was recorded before the episode with the robot at its start, ``target_future``
            (*B, T, D), and no longer true once the target was touched; else ``true_future`` (*B, F, D), which is.
        **parts: as of `DynamicPlanner`.
    """
    return DynamicPlanner.paper(static, RecordedFuture(horizon) if recorded else TrueFuture(), eta, **parts)


def wait_at_end(static: StaticPlanner, forecaster: Any, eta: Any, **parts: Any) -> DynamicPlanner:
    """Goes to where the forecast ends and waits there: the other extreme beside pursuit (paper, III-B.4)."""
    return DynamicPlanner.paper(static, forecaster, eta, **{"search": EndOfForecast(), **parts})
