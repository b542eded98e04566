"""The planners' memory between steps: kept in the tensordict under ``plan``; stored, recalled and reset only here."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.func import debug_unwrap

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.explaining import explain
from torchdyn_plan.planners.maneuver import Maneuver, NoState
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.planners.rows import where_rows
from torchdyn_plan.planners.schedule import Clock, Schedule

if TYPE_CHECKING:
    from torchdyn_plan.planners.delivery import Delivery
    from torchdyn_plan.planners.observation import Observation


class Slot(NamedTuple):
    """How the state of one part is stored in the memory, and how it starts and ages."""

    kind: type[Any]
    """Its `NamedTuple` of tensors ``(*B, …)``."""
    names: tuple[str, ...]
    """Its entries under ``plan``, one for each field."""
    start: Callable[[Observation], Any]
    """The state of rows at their first step."""
    older: Callable[[Any], Any] | None
    """The state one control step later; None if it does not age."""


REPORTED = ("replanned", "status")
"""Also written, for diagnosis: whether a row planned at this step, and its `PlanStatus`."""
SPARE_STEPS = 8
"""Extra control steps for which a path is kept, in case the next plan is late."""


class PlannerMemory:
    """The memory of a composed planner: its clock, plan in use, maneuver state, and plans under way."""

    def __init__(
        self, schedule: Schedule, maneuver: Maneuver, delivery: Delivery | None, *, turned: bool = False
    ) -> None:
        """Lay out the memory for these parts; raises `InputError` if two of them use the same name.

        With ``turned``, goals include the tool's orientation.
        """
        delay = 0 if delivery is None else delivery.delay
        lookahead = max(maneuver.lookahead, int(schedule.watches))
        self.path_length = lookahead + max(SPARE_STEPS, schedule.longest) + 2 * delay if lookahead else 0
        hold = partial(Plan.hold, length=self.path_length, turned=turned)
        self.slots = [
            Slot(Clock, Clock._fields, schedule.start, Clock.older),
            Slot(Plan, Plan._fields, hold, Plan.older),
            Slot(maneuver.State, maneuver.State._fields, maneuver.start, None),
        ]
        if delivery is None:
            self.slots.append(Slot(NoState, (), lambda _: NoState(), None))
        else:
            names = tuple(f"pending_{field}" for field in delivery.State._fields)
            self.slots.append(Slot(delivery.State, names, lambda seen: delivery.start(hold(seen)), delivery.older))
        self.names = [name for slot in self.slots for name in slot.names]
        written = [*self.names, *REPORTED]
        repeated = sorted({name for name in written if written.count(name) > 1})
        if repeated:
            raise InputError(f"two parts of a planner remember {', '.join(repeated)}: rename a field of a State")

    def recall(self, tensordict: TensorDictBase, observation: Observation, spoiled: Tensor | None = None) -> list[Any]:
        """The parts' states after the last step, aged by one step, in the order of ``slots``.

        Rows at step 0 and rows whose memory is ``spoiled`` (*B,) restart. If the tensordict holds no memory all rows
        restart, with a warning if some are past step 0.
        """
        plan = tensordict.get(keys.PLAN, None)
        # A plain dictionary: a look-up in a tensordict costs as much as a small tensor operation.
        stored = {} if plan is None else dict(plan.items())
        fresh = observation.step_count == 0
        lost = [name for name in self.names if name not in stored]
        if lost:
            warn_of_loss(lost[0], fresh)
        if spoiled is not None:
            fresh = fresh | spoiled
        some_fresh = torch.compiler.is_compiling() or bool(debug_unwrap(fresh).any())
        states = []
        for slot in self.slots:
            if not stored.keys() >= set(slot.names):
                states.append(slot.start(observation))
                continue
            state = slot.kind(*(stored[name] for name in slot.names))
            if slot.older is not None:
                state = slot.older(state)
            if some_fresh:
                pairs = zip(slot.start(observation), state, strict=True)
                state = slot.kind(*(where_rows(fresh, new, old) for new, old in pairs))
            states.append(state)
        return states

    def remember(self, tensordict: TensorDictBase, states: Sequence[Any], **report: Tensor) -> None:
        """Store the parts' states, in the order of ``slots``, and a ``report`` with the names `REPORTED`."""
        entries: dict[str, Tensor] = report
        for slot, state in zip(self.slots, states, strict=True):
            entries.update(zip(slot.names, state, strict=True))
        remember(tensordict, entries)

    def empty(self, observation: Observation) -> dict[str, Tensor]:
        """The entries of rows at their first step."""
        states = [(slot.names, slot.start(observation)) for slot in self.slots]
        return {name: value for names, state in states for name, value in zip(names, state, strict=True)}


def warn_of_loss(name: str, fresh: Tensor) -> None:
    """Warn if rows that are not ``fresh`` (*B,) have lost the entry ``name`` of their memory."""
    if torch.compiler.is_compiling() or bool(debug_unwrap(fresh).all()):
        return
    warnings.warn(
        f"the planner's memory is missing ('plan', {name!r} is absent) in rows that are past step 0, and it restarts "
        "there: carry it from step to step; an environment does with planner.make_tensordict_primer()",
        RuntimeWarning,
        stacklevel=2,
    )


def remember(tensordict: TensorDictBase, entries: Mapping[str, Tensor]) -> None:
    """Store ``entries`` under ``plan``; other entries there stay.

    Each step gets a new ``plan``, because tensordicts of earlier steps may share the old one.
    """
    stored = tensordict.get(keys.PLAN, None)
    # A plain dictionary: to look at a tensordict takes as long as a small operation.
    whole = {} if stored is None else dict(stored.items())
    if stored is not None and 2 * len(entries) < len(whole):
        # Each entry of a new tensordict is checked, which takes longer than to leave some out of one that is there.
        fresh = stored.exclude(*entries)
        for name, value in entries.items():
            fresh.set(name, value)
    else:
        fresh = TensorDict(whole | dict(entries), tensordict.batch_size, device=tensordict.device)
    tensordict.set(keys.PLAN, fresh)


class Remembering(TensorDictModuleBase):
    """A planner that keeps its memory in the tensordict under ``plan``.

    If it fails because of the tensordict's content, an `InputError` explains it in one sentence. The content is
    examined only after a failure, so that a step that works costs nothing extra.
    """

    def __call__(self, tensordict: Any, *more: Any, **settings: Any) -> Any:
        """As of every module."""
        if torch.compiler.is_compiling():
            return super().__call__(tensordict, *more, **settings)
        try:
            return super().__call__(tensordict, *more, **settings)
        except Exception as error:
            explanation = explain(error, self, tensordict)
            if explanation is None:
                raise
            raise explanation from error

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """Entries under ``plan`` of rows at step 0, with the batch, type and device of ``like`` (*B, D); here none."""
        return {}

    def make_tensordict_primer(self, dtype: torch.dtype = torch.float32, coordinates: int = 3) -> Any:
        """A TorchRL transform that makes environments carry the memory, `torchrl.envs.TensorDictPrimer`.

        Environments in other processes, and collectors over them, only carry what a spec declares. ``dtype`` is that of
        the environment's positions, and ``coordinates`` their number.
        """
        from torchrl.data import Composite, Unbounded
        from torchrl.envs.transforms import TensorDictPrimer

        entries = self.empty_memory(torch.zeros(coordinates, dtype=dtype))
        specs = {name: Unbounded(shape=value.shape, dtype=value.dtype) for name, value in entries.items()}
        return TensorDictPrimer(Composite({keys.PLAN: Composite(specs)}), default_value=0.0, expand_specs=True)
