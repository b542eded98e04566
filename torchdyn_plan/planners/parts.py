"""What a dynamic planner is made of: parts that can be exchanged, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_choice, check_number
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.analytic import ConstantVelocity
from torchdyn_plan.nets.arrival import ArrivalModel, FunctionArrival
from torchdyn_plan.nets.forecast import ForecastModel, FunctionForecast
from torchdyn_plan.nets.inference import Prepared
from torchdyn_plan.planners.delivery import Delivery
from torchdyn_plan.planners.maneuver import GoTo, Maneuver
from torchdyn_plan.planners.memory import REPORTED, PlannerMemory, Remembering
from torchdyn_plan.planners.observation import SEEN_BY_ALL, Observation
from torchdyn_plan.planners.plan import Lost
from torchdyn_plan.planners.pretrained import PretrainedPlanner
from torchdyn_plan.planners.protocol import keys_read, keys_written
from torchdyn_plan.planners.schedule import ReplanSchedule, Schedule, starting_at
from torchdyn_plan.planners.search.corner import CornerSearch
from torchdyn_plan.planners.search.exact import ExactSearch
from torchdyn_plan.planners.search.meeting import GoalSearch
from torchdyn_plan.planners.static.callable import TensorDictFunction
from torchdyn_plan.planners.turn import Turn

PARTS = ("static", "forecaster", "eta", "search", "schedule", "maneuver", "delivery", "lost", "turn", "chunk", "scene")
"""Arguments of a `ComposedPlanner`, and its attributes."""


class ComposedPlanner(PretrainedPlanner, Remembering):
    """Holds the parts of a planner for a moving target; `DynamicPlanner` uses them.

    Parts are immutable: `with_parts` makes another planner. In evaluation mode, in which planners are
    loaded, ``prepared`` holds copies of its models for inference. Plans are made by these wherever they stand for the
    models: `torchdyn_plan.nets.inference.Prepared` says where. ``train()`` drops them, ``eval()`` makes them again.
    """

    prepared: Prepared | None = None

    def __init__(
        self,
        static: Callable[..., Any],
        forecaster: ForecastModel | Callable[..., Any] | None = None,
        eta: ArrivalModel | Callable[..., Any] | None = None,
        *,
        search: GoalSearch | None = None,
        schedule: Schedule | None = None,
        maneuver: Maneuver | None = None,
        delivery: Delivery | None = None,
        lost: Lost | None = None,
        turn: Turn | None = None,
        chunk: int | None = None,
        scene: str | None = None,
    ) -> None:
        """Build from parts.

        Args:
            static: planner for a static goal, from tensordict to tensordict (`StaticPlanner`).
            forecaster: forecasts the target; a function of its history will do, which returns positions (*B, F, D). By
                default constant velocity, `torchdyn_plan.nets.ConstantVelocity`.
            eta: predicts how long ``static`` needs to a goal; may be a function from robot states (*B, 1, S) and goals
                (*B, K, D) to control steps (*B, K). By default ``static.arrival_model()``.
            search: chooses the meeting on the forecast; by default the first step at which both can be there.
            schedule: when to plan again; every fourth control step by default.
            maneuver: chooses the goal of the static planner at each step; the meeting place by default.
            delivery: when plans become available: `Delayed` or `Background`; at once by default.
            lost: decides when a target is lost; None if it cannot be.
            turn: orientation of the tool where it meets the target; then ``goal_pose`` is written beside ``goal``, of
                three coordinates, and ``static`` and ``eta`` should read it. None for positions alone.
            chunk: plan in blocks of exactly this many rows, so that results do not depend on the batch size.
            scene: digest of the scene that the planner belongs to; None if it belongs to none.

        Raises:
            InputError: a part is of no use, or there is no ``eta`` and ``static`` tells none.
        """
        super().__init__()
        if chunk is not None:
            check_number("chunk", chunk, minimum=1, integer=True)
        self.static = TensorDictFunction.wrap(static)
        self.forecaster = ConstantVelocity() if forecaster is None else FunctionForecast.wrap(forecaster)
        self.eta = arrival_of(static) if eta is None else FunctionArrival.wrap(eta)
        self.search = ExactSearch(stride=1, first=1) if search is None else search
        self.schedule = ReplanSchedule.every(4) if schedule is None else schedule
        self.maneuver, self.delivery = GoTo() if maneuver is None else maneuver, delivery
        self.lost, self.chunk, self.scene, self.turn = lost, chunk, scene, turn
        if turn is not None and not getattr(self.search, "reads_turn", False):
            raise InputError(f"{type(self.search).__name__} knows no turn of the tool: search with an ExactSearch")
        if turn is None and keys.GOAL_POSE in self.static.in_keys:
            raise InputError(
                f"{type(static).__name__} reads {keys.GOAL_POSE}: give the planner a turn, as WithTarget()"
            )
        self.memory = PlannerMemory(self.schedule, self.maneuver, delivery, turned=turn is not None)
        remembered = [(keys.PLAN, name) for name in self.memory.names]
        reported = [(keys.PLAN, name) for name in REPORTED]
        self.read_by_turn: tuple[Any, ...] = () if turn is None else tuple(turn.in_keys)
        seen = (*SEEN_BY_ALL, *self.forecaster.in_keys, *self.read_by_turn)
        self.in_keys = keys_read(self.static, *seen, *remembered)
        shared = [str(key[-1]) for key in (*remembered, *reported) if key in self.static.out_keys]
        if shared:
            raise InputError(f"the static planner and the planner both remember {', '.join(shared)}")
        goals = (keys.GOAL,) if turn is None else (keys.GOAL, keys.GOAL_POSE)
        self.out_keys = keys_written(self.static, *goals, keys.ARRIVAL_STEPS, *remembered, *reported)
        self.read_besides = [key for key in self.in_keys if key not in seen]
        self.read_by_static = [key for key in keys_read(self.static) if key not in SEEN_BY_ALL]

    @classmethod
    def paper(
        cls,
        static: Callable[..., Any],
        forecaster: ForecastModel | Callable[..., Any],
        eta: ArrivalModel | Callable[..., Any],
        **parts: Any,
    ) -> Self:
        """The paper's configuration: its corner search and its schedule, unless ``parts`` names others."""
        own: dict[str, Any] = {"search": CornerSearch(), "schedule": ReplanSchedule()}
        return cls(static, forecaster, eta, **(own | parts))

    def with_parts(self, **parts: Any) -> Self:
        """Another planner with some parts replaced, by the names of the constructor's arguments."""
        for name in parts:
            check_choice("part", name, PARTS)
        return type(self)(**(self.part_settings() | parts)).train(self.training)

    def for_noise(self, noise: float) -> Self:
        """The planner for targets that a track sees by measurements of standard deviation ``noise`` [m].

        It is another one where its forecaster has another for them; that one plans as soon as a target is seen well
        enough for it.
        """
        forecaster = self.forecaster.for_noise(noise)
        if forecaster is self.forecaster:
            return self
        schedule = self.schedule
        if forecaster.samples is not None:
            schedule = starting_at(schedule, forecaster.samples - 1)
        return self.with_parts(forecaster=forecaster, schedule=schedule)

    def part_settings(self) -> dict[str, Any]:
        """Arguments that make the same planner."""
        # Planners that are older than the turn keep their description.
        return {name: getattr(self, name) for name in PARTS if name != "turn" or self.turn is not None}

    def train(self, mode: bool = True) -> Self:
        """As of every module, and prepare the models where they are not to be trained."""
        super().train(mode)
        return self.prepare()

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """As of every module, and prepare the models where they have no derivatives."""
        super().requires_grad_(requires_grad)
        return self.prepare()

    def prepare(self) -> Self:
        """Copy the models as they are now, for inference; in training mode leave the copies. Returns the planner."""
        self.prepared = None if self.training else Prepared.of(self.forecaster.chosen, self.eta)
        return self

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """As of every module, which moves and converts by it."""
        super()._apply(fn, recurse)
        return self.prepare()

    def __getstate__(self) -> dict[str, Any]:
        # A copy has other weights, from which it prepares its models.
        return {**self.__dict__, "prepared": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.prepare()

    def for_inference(self) -> Self:
        """The same planner on copies of its networks as they are now, in as few operations as possible."""
        return self.with_parts(forecaster=self.forecaster.for_inference(), eta=self.eta.for_inference())

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """Entries below ``plan`` of rows at step 0, the static planner's among them; as `Remembering` says."""
        step = torch.zeros(like.shape[:-1], dtype=torch.int64, device=like.device)
        entries = self.memory.empty(Observation(like, like, like, step, ()))
        return entries | (self.static.empty_memory(like) if isinstance(self.static, Remembering) else {})


def arrival_of(static: Any) -> ArrivalModel:
    """What ``static`` says of its own arrival times; raises `InputError` if it says nothing."""
    tells = getattr(static, "arrival_model", None)
    if tells is None:
        raise InputError(
            f"eta is needed, as {type(static).__name__} has no arrival_model that tells how long it takes to a goal: "
            "give a function of robot states and goals, or a model of torchdyn_plan.nets"
        )
    return tells()
