"""Baselines for a planner of a moving target: two extremes, and one that knows the future."""

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
            static: see above.
            turn: orientation of the tool, for a static planner that reads ``goal_pose``.
            scene: digest of its scene; None if it has none.
        """
        super().__init__()
        self.static, self.scene, self.turn = TensorDictFunction.wrap(static), scene, turn
        goals = (keys.GOAL,) if turn is None else (keys.GOAL, keys.GOAL_POSE)
        self.in_keys = keys_read(self.static, keys.TARGET_POS, *(() if turn is None else turn.in_keys))
        self.out_keys = keys_written(self.static, *goals, keys.ARRIVAL_STEPS)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``goal`` (*B, D) [m, world], ``arrival_steps`` (*B,) of 0, and ``action``.

        Rows with a NaN or infinite input get action 0.
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
        """The static planner's memory, see `Remembering`."""
        return self.static.empty_memory(like) if isinstance(self.static, Remembering) else {}


@dataclass(frozen=True)
class EndOfForecast:
    """Search that always chooses the last position of the forecast: to go there and wait (paper, III-B.4)."""

    def __call__(
        self, forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext = NO_CONTEXT
    ) -> Meeting:
        """The end of the forecast, in F steps; one query of ``eta`` tells whether the robot can reach it."""
        goal = forecast.path[..., -1, :]
        never = eta(goal.unsqueeze(-2)).never.squeeze(-1)
        steps = torch.full_like(never, forecast.path.shape[-2], dtype=torch.int64)
        return Meeting(goal, steps, torch.zeros_like(never), ~never)


class RecordedFuture(ForecastModel):
    """A forecaster that returns the true future, from a recording of the same episode.

    Entry k of ``target_future`` is the target's position at step k of the episode, recorded with the arm at rest.
    """

    in_keys = (keys.TARGET_FUTURE, keys.STEP_COUNT)

    def __init__(self, horizon: int = 300) -> None:
        """Forecast ``horizon`` control steps; after the end of the recording the target stays in place."""
        super().__init__()
        check_number("horizon", horizon, minimum=1, integer=True)
        self.horizon = horizon

    def predict(self, *seen: Tensor) -> Forecast:
        """Positions at steps t+1 … t+F, ``(*B, F, D)``, from recordings ``(*B, T, D)`` and steps t (*B,) [m, world]."""
        target_future, step_count = seen
        check_points(keys.TARGET_FUTURE, target_future, _length(target_future))
        check_finite(keys.TARGET_FUTURE, target_future)
        ahead = torch.arange(1, self.horizon + 1, device=target_future.device)
        index = step_count.reshape(*target_future.shape[:-2], 1).long() + ahead
        index = index.clamp(max=target_future.shape[-2] - 1)
        return Forecast(target_future.gather(-2, index.unsqueeze(-1).expand(*index.shape, target_future.shape[-1])))

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this model."""
        return {"horizon": self.horizon}


class TrueFuture(ForecastModel):
    """A forecaster that returns the true future ``true_future``, even after contact with the robot.

    An evaluation simulates it from the present state with the robot at rest, again whenever the target has left what
    was simulated before.
    """

    in_keys = (keys.TRUE_FUTURE,)

    def predict(self, *seen: Tensor) -> Forecast:
        """Positions at steps t+1 … t+F, ``(*B, F, D)`` [m, world], as given."""
        (true_future,) = seen
        check_points(keys.TRUE_FUTURE, true_future, _length(true_future))
        check_finite(keys.TRUE_FUTURE, true_future)
        return Forecast(true_future)

    def part_settings(self) -> dict[str, Any]:
        """None."""
        return {}


def _length(path: Tensor) -> int:
    """Number of positions in ``path`` (*B, T, D), at least one."""
    return path.shape[-2] if path.ndim > 1 else 1


def oracle_trajectory(
    static: StaticPlanner, eta: Any, *, horizon: int = 300, recorded: bool = True, **parts: Any
) -> DynamicPlanner:
    """The paper's planner with the true future as its forecast (paper, IV-A.2).

    Args:
        static: see `DynamicPlanner`.
        eta: predicts the time that ``static`` needs to a goal.
        horizon: how far its search looks into the future [control steps].
        recorded: whether the future is ``target_future`` (*B, T, D), recorded before the episode with the robot at its
            start, which is wrong once the robot touches the target; else it is ``true_future`` (*B, F, D), which stays
            right.
        **parts: see `DynamicPlanner`.
    """
    return DynamicPlanner.paper(static, RecordedFuture(horizon) if recorded else TrueFuture(), eta, **parts)


def wait_at_end(static: StaticPlanner, forecaster: Any, eta: Any, **parts: Any) -> DynamicPlanner:
    """Goes to the end of the forecast and waits there: the opposite extreme to pursuit (paper, III-B.4)."""
    return DynamicPlanner.paper(static, forecaster, eta, **{"search": EndOfForecast(), **parts})
