"""What the dynamic planner is measured against."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.checks import check_finite, check_number, check_trailing_shape
from torchdyn_plan.planners.dynamic import DynamicPlanner
from torchdyn_plan.planners.protocol import ArrivalPredictor, GoalSearch, StaticPlanner, keys_read, keys_written, read
from torchdyn_plan.planners.schedule import Schedule
from torchdyn_plan.planners.search import SearchResult

if TYPE_CHECKING:
    from torchdyn_plan.nets.eta import Arrival


class TargetPursuit(TensorDictModuleBase):
    """Chases the target: at every step the goal is where the target is now (paper, Section IV-A.1)."""

    def __init__(self, static: StaticPlanner) -> None:
        """Chase with ``static``, a planner for a static goal."""
        super().__init__()
        self.static = static
        self.in_keys = keys_read(static, keys.TARGET_POS)
        self.out_keys = keys_written(static, keys.GOAL, keys.ARRIVAL_STEPS)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``goal`` (*B, 3) [m, world] and ``arrival_steps`` (*B,), which is 0, and act."""
        target_pos = read(tensordict, keys.TARGET_POS, "TargetPursuit")
        check_trailing_shape(keys.TARGET_POS, target_pos, 3)
        tensordict.set(keys.GOAL, target_pos)
        now = torch.zeros(target_pos.shape[:-1], dtype=torch.int64, device=target_pos.device)
        tensordict.set(keys.ARRIVAL_STEPS, now)
        return self.static(tensordict)


class EndOfForecast:
    """Search that always chooses the last position of the forecast."""

    def __call__(self, forecast: Tensor, target_pos: Tensor, eta: Callable[..., Arrival]) -> SearchResult:
        """The end of forecast (*B, F, 3), in F steps; ``eta`` is asked once, whether the robot is ever there."""
        goal = forecast[..., -1, :]
        never = eta(goal.unsqueeze(-2)).never.squeeze(-1)
        steps = torch.full_like(never, forecast.shape[-2], dtype=torch.int64)
        return SearchResult(goal, steps, torch.zeros_like(never), ~never)


class WaitAtEnd(DynamicPlanner):
    """Goes to where the forecast ends and waits there: the other extreme beside pursuit (paper, III-B.4)."""

    def __init__(
        self,
        static: StaticPlanner,
        forecaster: Callable[..., Tensor],
        eta: ArrivalPredictor,
        *,
        search: GoalSearch | None = None,
        schedule: Schedule | None = None,
        latency: int = 0,
        chunk: int | None = None,
    ) -> None:
        """Join the parts as `DynamicPlanner` does; ``search`` is `EndOfForecast` by default."""
        search = search or EndOfForecast()
        super().__init__(static, forecaster, eta, search=search, schedule=schedule, latency=latency, chunk=chunk)


class RecordedFuture(nn.Module):
    """Stands in for a forecaster and tells the truth, cut from a recording of the same episode.

    Entry k of ``target_future`` is where the target was at step k of the episode, with the arm held still.
    """

    in_keys = (keys.TARGET_FUTURE, keys.STEP_COUNT)

    def __init__(self, horizon: int = 300) -> None:
        """Tell ``horizon`` control steps; the target stays where its recording ends."""
        super().__init__()
        check_number("horizon", horizon, minimum=1, integer=True)
        self.horizon = horizon

    def forward(self, target_future: Tensor, step_count: Tensor) -> Tensor:
        """Positions at steps t+1 … t+F, ``(R, F, 3)``, of recordings ``(R, T, 3)`` [m, world] at steps t, R values."""
        check_trailing_shape(keys.TARGET_FUTURE, target_future, target_future.shape[-2], 3)
        check_finite(keys.TARGET_FUTURE, target_future)
        ahead = torch.arange(1, self.horizon + 1, device=target_future.device)
        index = (step_count.reshape(-1, 1) + ahead).clamp(max=target_future.shape[-2] - 1)
        return target_future.gather(-2, index.unsqueeze(-1).expand(-1, -1, 3))


class OracleTrajectory(DynamicPlanner):
    """The dynamic planner with the recorded truth, ``target_future`` (*B, T, 3), as its forecast (paper, IV-A.2)."""

    def __init__(
        self,
        static: StaticPlanner,
        eta: ArrivalPredictor,
        *,
        search: GoalSearch | None = None,
        schedule: Schedule | None = None,
        latency: int = 0,
        horizon: int = 300,
        chunk: int | None = None,
    ) -> None:
        """Join the parts as `DynamicPlanner` does; ``horizon`` [control steps] is as far as the search may look."""
        truth = RecordedFuture(horizon)
        super().__init__(static, truth, eta, search=search, schedule=schedule, latency=latency, chunk=chunk)

    @classmethod
    def from_pretrained(cls, name: str, *, latency: int = 0, chunk: int | None = None) -> OracleTrajectory:
        """The planner of that name with the recorded truth in place of its forecaster; raises what that one raises."""
        planner = DynamicPlanner.from_pretrained(name, chunk=chunk)
        horizon = getattr(getattr(planner.forecaster, "config", None), "horizon", 300)
        oracle = cls(
            planner.static, planner.eta, schedule=planner.schedule, horizon=horizon, latency=latency, chunk=chunk
        )
        oracle.gone_below = planner.gone_below
        return oracle.eval().requires_grad_(False)
