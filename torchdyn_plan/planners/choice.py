"""Several targets and one robot: which target to meet next."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.memory import Remembering, remember, warn_of_loss
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan, PlanStatus
from torchdyn_plan.planners.planner import DynamicPlanner
from torchdyn_plan.planners.pretrained import PretrainedPlanner
from torchdyn_plan.planners.protocol import keys_written, read
from torchdyn_plan.planners.rows import apply_to_rows, where_rows

NONE = -1
"""Slot of a row without a target."""
OUT_OF_REACH = 1e6
"""Control steps added to a target that cannot be met on its forecast."""


class Choice(NamedTuple):
    """The target that each row pursues."""

    choice_target: Tensor
    """``(*B,)`` int64 slot of the target, -1 for none."""
    choice_age: Tensor
    """``(*B,)`` int64 control steps since it was last compared with the others."""


NAMES = Choice._fields
"""What it remembers below ``plan``."""


@runtime_checkable
class Commits(Protocol):
    """A maneuver that must not switch targets while it runs, such as `MatchVelocity`."""

    def committed(self, state: Any, /) -> Tensor:
        """``(*B,)`` bool: rows that must keep their target."""
        ...

    def finished(self, state: Any, /) -> Tensor:
        """``(*B,)`` bool: rows that are done with their target and start over."""
        ...


class ChoosingPlanner(PretrainedPlanner, Remembering):
    """Lets a `DynamicPlanner` meet one target after another, out of up to K in each row.

    Reads ``targets_present`` (*B, K) bool, ``targets_pos`` (*B, K, D) and, for all targets, what the planner reads for
    one (`torchdyn_plan.keys.OF_ALL_TARGETS`). Every few steps it plans a meeting with each target, with one forward
    pass of the forecaster and one of the arrival model. It chooses the target that can be met soonest; if
    ``targets_value`` (*B, K) is given, the most valuable of the targets that can be met, ties going to the soonest. The
    planner sees the chosen target only, and restarts when the target changes; the tensordict's own entries are left
    unchanged. A row without targets holds still, with `PlanStatus.TARGET_LOST`. A maneuver that `Commits` keeps its
    target until it has finished.

    ``plan.choice_target`` holds the slot of each row's target, -1 for none.
    """

    def __init__(self, planner: DynamicPlanner, *, every: int = 10, sooner: float = 25.0) -> None:
        """Choose for ``planner``.

        Args:
            planner: a planner for one target.
            every: control steps between comparisons of the targets.
            sooner: another target replaces the chosen one only if it can be met this many control steps sooner.
        """
        super().__init__()
        if not isinstance(planner, DynamicPlanner):
            raise InputError(f"planner must be a DynamicPlanner, got {type(planner).__name__}")
        check_number("every", every, minimum=1, integer=True)
        check_number("sooner", sooner, minimum=0.0)
        self.planner, self.every, self.sooner = planner, every, sooner
        read_of_one = (keys.TARGET_POS, *planner.forecaster.in_keys, *planner.read_by_turn)
        unknown = [key for key in read_of_one if key not in keys.OF_ALL_TARGETS]
        if unknown:
            raise InputError(
                f"the planner reads {', '.join(map(str, unknown))}, which is not available for several targets"
            )
        self.of_one = tuple(dict.fromkeys(read_of_one))
        self.of_all = tuple(keys.OF_ALL_TARGETS[key] for key in self.of_one)
        own: list[Any] = [(keys.PLAN, name) for name in NAMES]
        others = [key for key in planner.in_keys if key not in self.of_one]
        read_keys: list[Any] = list(dict.fromkeys([keys.TARGETS_PRESENT, *self.of_all, *others, *own]))
        self.in_keys = read_keys
        self.out_keys = keys_written(planner, *own)

    @property
    def scene(self) -> str | None:
        """Digest of the planner's scene."""
        return self.planner.scene

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose a target in the rows that are due, and run the planner on it."""
        present = read(tensordict, keys.TARGETS_PRESENT, "ChoosingPlanner").bool()
        step_count = read(tensordict, keys.STEP_COUNT, "ChoosingPlanner").reshape(present.shape[:-1])
        for key in self.of_all:
            value = read(tensordict, key, "ChoosingPlanner")
            check_trailing_shape(key, value, *present.shape, *value.shape[present.ndim :])
        before, finished, committed = self._recall(tensordict, step_count)
        chosen = before.choice_target
        there = (chosen >= 0) & present.gather(-1, chosen.clamp_min(0).unsqueeze(-1)).squeeze(-1)
        due = ~committed & (finished | ~there | (before.choice_age >= self.every))
        # A single target needs no comparison.
        several = present.sum(-1) > 1
        only = torch.where(present.any(-1), present.long().argmax(-1), NONE)
        chosen_yet = torch.where(finished | ~there, NONE, chosen)
        target = self._choose(tensordict, present, due & several, torch.where(due & ~several, only, chosen_yet))
        target = torch.where(committed, chosen, target)
        anew = (target != chosen) | finished
        self._act(tensordict, target, anew, step_count)
        age = torch.where(due, 0, before.choice_age) + 1
        # At its first step a row has not seen its targets move yet, so it compares them again at the next.
        age = torch.where(step_count == 0, self.every, age)
        status = tensordict.get((keys.PLAN, "status"))
        status = status.masked_fill(target < 0, int(PlanStatus.TARGET_LOST))
        remember(tensordict, {"status": status} | dict(zip(NAMES, Choice(target, age), strict=True)))
        return tensordict

    def values(self, observation: Observation) -> Tensor:
        """Control steps ``(*B,)`` until a target can be met, plus `OUT_OF_REACH` if it cannot; one pass of each model.

        ``observation`` has one target in each row; its batch may be (*B, K).
        """
        plan = self.planner.replan(observation, Plan.hold(observation, 0, turned=self.planner.turn is not None))
        late = OUT_OF_REACH * (~plan.reachable | ~plan.usable)
        return plan.arrival_steps.to(observation.tool_pos.dtype) + late

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """The memory of the choice and of the planner, see `Remembering`."""
        return dict(zip(NAMES, self._none(like[..., 0]), strict=True)) | self.planner.empty_memory(like)

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this planner."""
        return {name: getattr(self, name) for name in ("planner", "every", "sooner")}

    def for_inference(self) -> ChoosingPlanner:
        """A copy with the planner's current networks prepared for inference, in as few operations as possible."""
        settings: dict[str, Any] = self.part_settings() | {"planner": self.planner.for_inference()}
        return type(self)(**settings).train(self.training)

    def _none(self, like: Tensor) -> Choice:
        """No target, with a choice due at once, for rows ``like`` (*B,)."""
        nothing = torch.full(like.shape, NONE, dtype=torch.int64, device=like.device)
        return Choice(nothing, torch.full_like(nothing, self.every))

    def _recall(self, tensordict: TensorDictBase, step_count: Tensor) -> tuple[Choice, Tensor, Tensor]:
        """The choice of the last step, and the rows ``(*B,)`` whose maneuver has finished, and that are committed."""
        start, plan = self._none(step_count), tensordict.get(keys.PLAN, None)
        stored: dict[str, Any] = {} if plan is None else dict(plan.items())
        no = torch.zeros_like(step_count, dtype=torch.bool)
        if any(name not in stored for name in NAMES):
            warn_of_loss(NAMES[0], step_count == 0)
            return start, no, no
        fresh = step_count == 0
        choice = Choice(*(where_rows(fresh, *pair) for pair in zip(start, (stored[n] for n in NAMES), strict=True)))
        kind: Any = self.planner.maneuver.State
        maneuver = self.planner.maneuver
        if not isinstance(maneuver, Commits) or any(name not in stored for name in kind._fields):
            return choice, no, no
        state = kind(*(stored[name] for name in kind._fields))
        return choice, maneuver.finished(state) & ~fresh, maneuver.committed(state) & ~fresh

    def _choose(self, tensordict: TensorDictBase, present: Tensor, due: Tensor, chosen: Tensor) -> Tensor:
        """Slots ``(*B,)`` of the targets: newly chosen in the rows ``due``, ``chosen`` in the others."""
        value = tensordict.get(keys.TARGETS_VALUE, None)
        value = torch.zeros(present.shape, device=present.device) if value is None else value
        robot = [read(tensordict, key, "ChoosingPlanner") for key in (keys.TOOL_POS, keys.ROBOT_STATE)]
        step_count = read(tensordict, keys.STEP_COUNT, "ChoosingPlanner").reshape(present.shape[:-1])
        targets = [tensordict.get(key) for key in self.of_all]
        names = list(self.of_one)
        wanted = (*self.planner.forecaster.in_keys, *self.planner.read_by_turn)

        def compare(*rows: Tensor) -> tuple[Tensor]:
            tool_pos, robot_state, steps, there, worth, now, *seen = rows
            count = there.shape[-1]
            each = [one.unsqueeze(1).expand(len(one), count, *one.shape[1:]) for one in (tool_pos, robot_state, steps)]
            # The content of an empty slot does not matter, and may be NaN.
            seen = [torch.nan_to_num(one) for one in seen]
            position = seen[names.index(keys.TARGET_POS)]
            read_of_one = tuple(seen[names.index(key)] for key in wanted)
            needed = self.values(Observation(each[0], position, each[1], each[2], read_of_one))
            own = torch.arange(count, device=now.device) == now.unsqueeze(-1)
            needed = needed - self.sooner * own
            can = there & (needed < 0.5 * OUT_OF_REACH)
            worth = torch.where(can, worth, -torch.inf)
            most = (worth == worth.amax(-1, keepdim=True)) & there
            best = torch.where(most, needed, torch.inf).argmin(-1)
            return (torch.where(there.any(-1), best, NONE),)

        inputs = (*robot, step_count, present, value, chosen, *targets)
        return apply_to_rows(compare, due, inputs, (chosen,), chunk=self.planner.chunk)[0]

    def _act(self, tensordict: TensorDictBase, target: Tensor, anew: Tensor, step_count: Tensor) -> None:
        """Run the planner on the targets in slots ``target`` (*B,); it restarts in the rows ``anew``."""
        shown: dict[Any, Tensor] = {}
        for one, of_all in zip(self.of_one, self.of_all, strict=True):
            value = tensordict.get(of_all)
            index = target.clamp_min(0)[(..., *[None] * (value.ndim - target.ndim))]
            picked = value.gather(target.ndim, index.expand(*target.shape, 1, *value.shape[target.ndim + 1 :]))
            shown[one] = where_rows(target < 0, torch.full_like(picked, torch.nan), picked).squeeze(target.ndim)
        steps = read(tensordict, keys.STEP_COUNT, "ChoosingPlanner")
        shown[keys.STEP_COUNT] = torch.where(anew, 0, step_count).reshape(steps.shape)
        original = {key: tensordict.get(key, None) for key in shown}
        for key, value in shown.items():
            tensordict.set(key, value)
        self.planner(tensordict)
        for key, value in original.items():
            if value is None:
                tensordict.pop(key)
            else:
                tensordict.set(key, value)
