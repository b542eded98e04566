"""The exchangeable parts of a dynamic planner, and what follows from them."""

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
from torchdyn_plan.nets.capture import CaptureModel, FunctionCapture
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

PARTS = (
    "static",
    "forecaster",
    "eta",
    "capture",
    "search",
    "schedule",
    "maneuver",
    "delivery",
    "lost",
    "turn",
    "chunk",
    "scene",
)
"""Arguments of a `ComposedPlanner`, which are also its attributes."""
LATER = ("capture", "turn")
"""Those that are left out of a description if there are none."""


class ComposedPlanner(PretrainedPlanner, Remembering):
    """Holds the parts of a planner for a moving target; `DynamicPlanner` uses them.

    Parts are immutable: `with_parts` makes another planner. In evaluation mode, in which planners are loaded,
    ``prepared`` holds copies of its models for inference, and plans are made with these copies where
    `torchdyn_plan.nets.inference.Prepared` allows it. ``train()`` drops them, ``eval()`` makes them again.
    """

    prepared: Prepared | None = None

    def __init__(
        self,
        static: Callable[..., Any],
        forecaster: ForecastModel | Callable[..., Any] | None = None,
        eta: ArrivalModel | Callable[..., Any] | None = None,
        *,
        capture: CaptureModel | Callable[..., Any] | None = None,
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
            forecaster: forecasts the target; may be a function from its history to positions (*B, F, D). By default
                constant velocity, `torchdyn_plan.nets.ConstantVelocity`.
            eta: predicts the time that ``static`` needs to a goal; may be a function from robot states (*B, 1, S) and
                goals (*B, K, D) to control steps (*B, K). By default ``static.arrival_model()``.
            capture: predicts how likely it is that a robot that waits at a goal captures the target; may be a function
                from paths (*B, F + 1, D), goals (*B, K, D) and steps (*B, K) to probabilities (*B, K). Read by a search
                with a ``probability_weight``; None if nothing is known of it.
            search: chooses the meeting on the forecast; by default the first step at which both can be there.
            schedule: when to plan again; every fourth control step by default.
            maneuver: chooses the goal of the static planner at each step; the meeting place by default.
            delivery: when plans become available: `Delayed` or `Background`; at once by default.
            lost: decides when a target is lost; None if targets cannot be lost.
            turn: orientation of the tool where it meets the target. Then ``goal_pose`` is written in addition to
                ``goal``, of three coordinates, and ``static`` and ``eta`` should read it. None for positions only.
            chunk: plan in blocks of exactly this many rows, so that results do not depend on the batch size; a multiple
                of 32, as `IKPlanner` says.
            scene: digest of the scene that the planner belongs to; None if it belongs to none.

        Raises:
            InputError: a part is invalid, or no ``eta`` is given and ``static`` has no ``arrival_model``.
        """
        super().__init__()
        if chunk is not None:
            check_number("chunk", chunk, minimum=1, integer=True)
        self.static = TensorDictFunction.wrap(static)
        self.forecaster = ConstantVelocity() if forecaster is None else FunctionForecast.wrap(forecaster)
        self.eta = arrival_of(static) if eta is None else FunctionArrival.wrap(eta)
        self.capture = None if capture is None else FunctionCapture.wrap(capture)
        self.search = ExactSearch(stride=1, first=1) if search is None else search
        self.schedule = ReplanSchedule.every(4) if schedule is None else schedule
        self.maneuver, self.delivery = GoTo() if maneuver is None else maneuver, delivery
        self.lost, self.chunk, self.scene, self.turn = lost, chunk, scene, turn
        if turn is not None and not getattr(self.search, "reads_turn", False):
            raise InputError(
                f"{type(self.search).__name__} does not support a turn of the tool: search with an ExactSearch"
            )
        if turn is None and keys.GOAL_POSE in self.static.in_keys:
            raise InputError(
                f"{type(static).__name__} reads {keys.GOAL_POSE}: give the planner a turn such as WithTarget()"
            )
        self.memory = PlannerMemory(self.schedule, self.maneuver, delivery, turned=turn is not None)
        remembered = [(keys.PLAN, name) for name in self.memory.names]
        reported = [(keys.PLAN, name) for name in REPORTED]
        self.read_by_turn: tuple[Any, ...] = () if turn is None else tuple(turn.in_keys)
        seen = (*SEEN_BY_ALL, *self.forecaster.in_keys, *self.read_by_turn)
        self.in_keys = keys_read(self.static, *seen, *remembered)
        shared = [str(key[-1]) for key in (*remembered, *reported) if key in self.static.out_keys]
        if shared:
            raise InputError(f"the static planner and the planner both store {', '.join(shared)}")
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
        """The planner for targets tracked from measurements of standard deviation ``noise`` [m].

        This is another planner if the forecaster, or the static planner by a method ``for_noise``, has a variant for
        that noise. With another forecaster it plans as soon as the target is tracked well enough for it.
        """
        parts: dict[str, Any] = {}
        forecaster, variant = self.forecaster.for_noise(noise), getattr(self.static, "for_noise", None)
        if variant is not None and (steady := variant(noise)) is not self.static:
            parts["static"] = steady
        if forecaster is not self.forecaster:
            parts["forecaster"] = forecaster
            if forecaster.samples is not None:
                parts["schedule"] = starting_at(self.schedule, forecaster.samples - 1)
        return self.with_parts(**parts) if parts else self

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this planner."""
        # Left out if absent, so that planners saved before these parts existed keep their description.
        given = {name: getattr(self, name) for name in PARTS}
        return {name: part for name, part in given.items() if name not in LATER or part is not None}

    def train(self, mode: bool = True) -> Self:
        """Set the mode, and prepare the models for inference in evaluation mode."""
        super().train(mode)
        return self.prepare()

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """Freeze or unfreeze the weights, and prepare the models again."""
        super().requires_grad_(requires_grad)
        return self.prepare()

    def prepare(self) -> Self:
        """Copy the current models for inference, or drop the copies in training mode. Returns the planner."""
        self.prepared = None if self.training else Prepared.of(self.forecaster.chosen, self.eta, self.capture)
        return self

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move or convert, and prepare the models again."""
        super()._apply(fn, recurse)
        return self.prepare()

    def __getstate__(self) -> dict[str, Any]:
        # A copy prepares its models from its own weights.
        return {**self.__dict__, "prepared": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.prepare()

    def for_inference(self) -> Self:
        """A copy with the current networks prepared for inference, in as few operations as possible."""
        capture = None if self.capture is None else self.capture.for_inference()
        own = {"forecaster": self.forecaster.for_inference(), "eta": self.eta.for_inference(), "capture": capture}
        return self.with_parts(**own)

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """Entries under ``plan`` of rows at step 0, including the static planner's, see `Remembering`."""
        step = torch.zeros(like.shape[:-1], dtype=torch.int64, device=like.device)
        entries = self.memory.empty(Observation(like, like, like, step, ()))
        return entries | (self.static.empty_memory(like) if isinstance(self.static, Remembering) else {})


def arrival_of(static: Any) -> ArrivalModel:
    """The ``arrival_model`` of ``static``; raises `InputError` if it has none."""
    tells = getattr(static, "arrival_model", None)
    if tells is None:
        raise InputError(
            f"eta is needed, because {type(static).__name__} has no arrival_model that predicts its time to a goal: "
            "give a function of robot states and goals, or a model of torchdyn_plan.nets"
        )
    return tells()
