"""The idea of this package: a planner for a static target, made to meet a moving one."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_choice, check_number, check_same_device, check_trailing_shape
from torchdyn_plan.planners.ik import IKPlanner
from torchdyn_plan.planners.memory import MEMORY_KEYS, carry_on, recall, remember
from torchdyn_plan.planners.policy import PolicyPlanner
from torchdyn_plan.planners.protocol import ArrivalPredictor, GoalSearch, StaticPlanner, keys_read, keys_written, read
from torchdyn_plan.planners.rows import apply_to_rows
from torchdyn_plan.planners.schedule import ReplanSchedule
from torchdyn_plan.planners.search import CornerSearch, SearchResult
from torchdyn_plan.planners.status import held, input_status, plan_status, try_again, usable_forecast

STATIC_PLANNERS: dict[str, Callable[..., TensorDictModuleBase]] = {
    "ik": IKPlanner,
    "rl": partial(PolicyPlanner.from_pretrained, "trapper"),
}
"""What makes the static planners that ship, by name; each takes ``chunk``."""
PRETRAINED = {f"trapper-{name}": (name, "trapper", f"trapper-{name}") for name in STATIC_PLANNERS}
"""Name → names of the static planner, of the forecaster's weights, and of the ETA network's weights."""

SUNK = -0.042
"""A ball of Trapper whose centre is lower is in a pocket [m, world]."""


class DynamicPlanner(TensorDictModuleBase):
    """Meets a moving target: history → forecast → goal search → ``goal``, ``arrival_steps`` → static planner → action.

    Rows plan anew when their schedule says so and keep their goal in between; before its first plan a row stays where
    its tool is. A tensordict goes in, of any batch size, and the same one comes out, with `goal` (*B, 3) [m, world],
    `arrival_steps` (*B,), whatever the static planner writes, and the memory for the next step under ``plan``. Rows
    with ``step_count`` 0 start afresh, so that one planner serves environments that reset at different moments.

    ``plan.status`` (*B,) says how each row stands, in the codes of `PlanStatus`. A row that cannot plan when a plan is
    due, because its input or its forecast is no number or its target is gone, holds its tool still and tries again at
    every step; other rows do not notice.
    """

    def __init__(
        self,
        static: StaticPlanner,
        forecaster: Callable[..., Tensor],
        eta: ArrivalPredictor,
        *,
        search: GoalSearch | None = None,
        schedule: ReplanSchedule | None = None,
        gone_below: float | None = None,
        chunk: int | None = None,
    ) -> None:
        """Join the parts.

        Args:
            static: planner for a static goal.
            forecaster: maps what it reads, ``target_history`` (*B, H, 3) or its own ``in_keys``, to the target's
                positions in the next F control steps, ``(*B, F, 3)`` [m, world].
            eta: tells how long ``static`` needs to a goal.
            search: chooses the goal on the forecast; the paper's corner search by default.
            schedule: when to plan anew; the paper's by default.
            gone_below: a target whose centre is lower has left the table [m, world]; None if it cannot.
            chunk: plan in blocks of exactly this many rows, so that results do not depend on the batch size.
        """
        super().__init__()
        if chunk is not None:
            check_number("chunk", chunk, minimum=1, integer=True)
        if gone_below is not None:
            check_number("gone_below", gone_below)
        self.gone_below = -math.inf if gone_below is None else gone_below
        self.static, self.forecaster, self.eta = static, forecaster, eta
        self.search, self.schedule, self.chunk = search or CornerSearch(), schedule or ReplanSchedule(), chunk
        self.seen_keys = tuple(getattr(forecaster, "in_keys", (keys.TARGET_HISTORY,)))
        state = (keys.ROBOT_STATE, keys.TARGET_POS, keys.TOOL_POS, keys.STEP_COUNT)
        self.in_keys = keys_read(static, *state, *self.seen_keys)
        self.out_keys = keys_written(static, keys.GOAL, keys.ARRIVAL_STEPS, *MEMORY_KEYS)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Plan where a plan is due, and act.

        Raises:
            InputError: a key is missing, a shape is wrong, or data and networks are on different devices.
        """
        tool_pos, target_pos, robot_state, step_count, *seen = self._read(tensordict)
        memory = recall(tensordict)
        clock, due = self.schedule.tick(None if memory is None else memory.clock, step_count)
        meeting = carry_on(memory, tool_pos, step_count)
        trouble = input_status(target_pos, seen, self.gone_below)
        able = due & (trouble == 0)
        *planned, usable = apply_to_rows(
            self._plan_rows, able, (robot_state, target_pos, *seen), (*meeting, able), chunk=self.chunk
        )
        failed = due & ~usable
        meeting = held(SearchResult(*planned), failed, tool_pos)
        clock = try_again(clock, failed, memory, self.schedule, step_count)
        status = plan_status(trouble, failed, clock, meeting.reachable)
        remember(tensordict, clock, meeting, replanned=due & usable, status=status)
        return self.static(tensordict)

    def plan(self, robot_state: Tensor, target_pos: Tensor, *seen: Tensor) -> SearchResult:
        """Forecast and choose a meeting, for robot states (*B, S), targets (*B, 3) and what the forecaster reads."""
        return self._choose(self.forecaster(*seen), robot_state, target_pos)

    def _plan_rows(self, robot_state: Tensor, target_pos: Tensor, *seen: Tensor) -> tuple[Tensor, ...]:
        """`plan`, whatever the forecaster returns, and whether that was of any use, ``(R,)``."""
        forecast, usable = usable_forecast(self.forecaster(*seen), target_pos)
        return *self._choose(forecast, robot_state, target_pos), usable

    def _choose(self, forecast: Tensor, robot_state: Tensor, target_pos: Tensor) -> SearchResult:
        eta = partial(self.eta.arrival, robot_state.unsqueeze(-2))
        return self.search(forecast, target_pos, eta)

    def _read(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Tool and target (*B, 3) [m, world], robot state (*B, S), step count (*B,), and what the forecaster reads."""
        get = partial(read, tensordict, reader=self._get_name())
        tool_pos, target_pos, robot_state = get(keys.TOOL_POS), get(keys.TARGET_POS), get(keys.ROBOT_STATE)
        seen = [get(key) for key in self.seen_keys]
        if not torch.compiler.is_compiling():
            self._check(tool_pos, target_pos, dict(zip(self.seen_keys, seen, strict=True)))
        return [tool_pos, target_pos, robot_state, get(keys.STEP_COUNT).reshape(tool_pos.shape[:-1]), *seen]

    def _check(self, tool_pos: Tensor, target_pos: Tensor, seen: dict[str, Tensor]) -> None:
        check_trailing_shape(keys.TOOL_POS, tool_pos, 3)
        check_trailing_shape(keys.TARGET_POS, target_pos, 3)
        parameter = next(self.parameters(), None)
        if parameter is not None:
            check_same_device(keys.TARGET_POS, target_pos, parameter.device, "the planner")
        history = seen.get(keys.TARGET_HISTORY)
        if history is not None:
            length = getattr(getattr(self.forecaster, "config", None), "history", history.shape[-2])
            check_trailing_shape(keys.TARGET_HISTORY, history, length, 3)

    @classmethod
    def from_pretrained(cls, name: str, *, chunk: int | None = None) -> DynamicPlanner:
        """A planner with the weights that ship with the package: ``"trapper-ik"`` or ``"trapper-rl"``.

        Raises:
            InputError: there is no planner of that name; the message lists those there are.
            WeightsError: the weights cannot be read.
        """
        check_choice("planner", name, PRETRAINED)
        from torchdyn_plan.nets import ETANetwork, Forecaster

        static, forecaster, eta = PRETRAINED[name]
        networks = Forecaster.from_pretrained(forecaster), ETANetwork.from_pretrained(eta)
        planner = cls(STATIC_PLANNERS[static](chunk=chunk), *networks, chunk=chunk)
        planner.gone_below = SUNK
        return planner.eval().requires_grad_(False)
