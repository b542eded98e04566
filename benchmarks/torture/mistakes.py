"""People's mistakes with planners: entries of other kinds and shapes, tensordicts that cannot be written to."""

from __future__ import annotations

import functools
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import torch
from tensordict import LazyStackedTensorDict, TensorDict

from benchmarks.torture.promise import Cases, Promise, attempt
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.planners import (
    CallablePlanner,
    CornerSearch,
    Delayed,
    EventSchedule,
    IKPlanner,
    PolicyPlanner,
    SoftExactSearch,
)
from torchdyn_plan.tasks import load_task

ROWS, STEPS = 4, 14
"""Rows of what planners see, and how far into the episode: where a first plan is due."""


def _task(task: str, name: str, static: str, **parts: Any) -> Callable[[], Any]:
    def make() -> Any:
        planner = load_task(task).planner(name, static)
        return planner.with_parts(**parts) if parts else planner

    return make


def _straight(robot_state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    # What a person's own function says of a state of another size is his own.
    return torch.cat([goal.clamp(-1, 1), goal.clamp(-1, 1)], -1)


PLANNERS: dict[str, tuple[str, Callable[[], Any]]] = {
    "corner": ("trapper", _task("trapper", "corner", "ik")),
    "corner with a policy": ("trapper", _task("trapper", "corner", "rl")),
    "exact": ("trapper", _task("trapper", "exact", "ik")),
    "wait and drop": ("trapper", _task("trapper", "wait_and_drop", "ik")),
    "wait and drop with a policy": ("trapper", _task("trapper", "wait_and_drop", "rl")),
    "delayed": ("trapper", _task("trapper", "wait_and_drop", "ik", delivery=Delayed(2))),
    "on events": ("trapper", _task("trapper", "corner", "ik", schedule=EventSchedule(minimum=5, first_step=13))),
    "soft": ("trapper", _task("trapper", "corner", "ik", search=SoftExactSearch())),
    "expectation": ("trapper", _task("trapper", "corner", "ik", search=CornerSearch(estimator="expectation"))),
    "for inference": ("trapper", lambda: load_task("trapper").planner("corner", "ik").for_inference()),
    "pursuit": ("trapper", _task("trapper", "pursuit", "ik")),
    "pursuit with a policy": ("trapper", _task("trapper", "pursuit", "rl")),
    "ik": ("trapper", lambda: load_task("trapper").static_planner("ik")),
    "ik straight": ("trapper", lambda: IKPlanner(Arm.ur5(tool_length=0.1))),
    "policy that holds": ("trapper", lambda: PolicyPlanner.from_pretrained("trapper", period=4)),
    "function": ("trapper", lambda: CallablePlanner(_straight)),
    "reach corner": ("fetch_reach", _task("fetch_reach", "corner", "proportional")),
    "reach pursuit": ("fetch_reach", _task("fetch_reach", "pursuit", "proportional")),
}
"""Planners of every kind, and the task whose keys they read."""

ENTRIES: dict[str, Callable[[torch.Tensor], Any]] = {
    "one less": lambda value: value[..., :-1],
    "twice": lambda value: torch.cat([value, value], -1),
    "an axis at the end": lambda value: value.unsqueeze(-1),
    "an axis in the middle": lambda value: value.unsqueeze(1),
    "an axis at the front": lambda value: value.unsqueeze(0),
    "an axis less": lambda value: value[..., 0],
    "a scalar": lambda value: value.reshape(-1)[0],
    "no rows": lambda value: value[:0],
    "more rows": lambda value: torch.cat([value, value]),
    "no entries": lambda value: value[..., :0],
    "transposed": lambda value: value.transpose(0, -1),
    "float64": lambda value: value.double(),
    "float16": lambda value: value.half(),
    "bfloat16": lambda value: value.bfloat16(),
    "int64": lambda value: value.nan_to_num().long(),
    "uint8": lambda value: value.nan_to_num().to(torch.uint8),
    "bool": lambda value: value.bool(),
    "complex": lambda value: value.to(torch.complex64),
    "NaN": lambda value: torch.full_like(value, torch.nan) if value.is_floating_point() else value,
    "huge": lambda value: value * 10**9,
    "negative": lambda value: -value - 1,
    "numpy": lambda value: value.numpy(),
    "numpy float64": lambda value: value.double().numpy(),
    "list": lambda value: value.tolist(),
    "None": lambda value: None,
    "text": lambda value: "here",
    "number": lambda value: 3.0,
    "meta": lambda value: value.to("meta"),
    "with gradient": lambda value: value.float().requires_grad_(),
    "not contiguous": lambda value: torch.stack([value, value], -1)[..., 0],
    "expanded": lambda value: value[:1].expand_as(value),
    "sparse": lambda value: value.to_sparse(),
    "parameter": lambda value: torch.nn.Parameter(value.float()),
    "tensordict": lambda value: TensorDict({"x": value}, value.shape[:1]),
}
"""What becomes of an entry."""
GONE = "gone"
"""The entry is left out."""


_memmaps = tempfile.TemporaryDirectory(prefix="torture-memmaps-")
"""Gone when the process ends."""


def _memmap(td: Any) -> Any:
    return td.memmap_(tempfile.mkdtemp(dir=_memmaps.name))


WHOLE: dict[str, Callable[[Any], Any]] = {
    "as it is": lambda td: td,
    "locked": lambda td: td.lock_(),
    "memmap": _memmap,
    "shared": lambda td: td.share_memory_(),
    "list": lambda td: [td],
    "None": lambda td: None,
    "dict": lambda td: dict(td.items()),
    "tensor": lambda td: td["tool_pos"],
    "no rows": lambda td: td[:0],
    "one row without an axis": lambda td: td[0],
    "two axes": lambda td: td.reshape(2, -1) if len(td) == ROWS else td,
    "lazy stack": lambda td: LazyStackedTensorDict(*td.unbind(0)),
    "no batch size": lambda td: TensorDict(dict(td.items()), []),
    "another batch size": lambda td: TensorDict(td.to_dict(), [ROWS, 3][:1]),
    "view": lambda td: td.view(-1),
    "expanded": lambda td: td.unsqueeze(0).expand(2, *td.shape),
    "all in float64": lambda td: td.double(),
    "all in float16": lambda td: td.half(),
    "on meta": lambda td: td.to("meta"),
    "empty": lambda td: td.empty(),
}
"""What becomes of the tensordict."""


@functools.cache
def planner(name: str) -> Any:
    """The planner of that name."""
    return PLANNERS[name][1]()


@functools.cache
def _seen(task: str) -> Any:
    made = load_task(task)
    env = made.make_env(made.default_settings(), num_envs=ROWS, seed=0, split="dev", num_threads=1)
    td = env.reset()
    for _ in range(STEPS):
        td = env.step_and_maybe_reset(env.rand_action(td))[1]
    return td.exclude("plan").set("goal", td["target_pos"] + 0.05)


@functools.cache
def good(name: str) -> Any:
    """What the planner ``name`` sees when nobody makes a mistake, its own memory of the step before among it."""
    td = planner(name)(_seen(PLANNERS[name][0]).clone())
    td["step_count"] = td["step_count"] + 1
    return td


def keys_of(name: str) -> list[Any]:
    """Keys that the planner ``name`` reads, what it remembers among them."""
    remembered = good(name).get("plan", None)
    within = [] if remembered is None else [("plan", entry) for entry in sorted(remembered.keys())]
    return [*dict.fromkeys([*planner(name).in_keys, *within, "plan"])]


def make_mistakes(name: str, changes: Sequence[tuple[Any, str]], whole: str) -> Any:
    """What the planner ``name`` sees after mistakes with some keys and with all; raises where it cannot be made."""
    td = good(name).clone()
    for key, change in changes:
        if td.get(key, None) is None:
            continue
        if change == GONE:
            del td[key]
            continue
        value = td.get(key)
        made = ENTRIES[change](value) if isinstance(value, torch.Tensor) else 3.0
        if isinstance(made, torch.Tensor) and made.shape[:1] != td.batch_size:
            # A tensordict without a batch size takes what one of four rows refuses.
            td.batch_size = torch.Size(())
            for nested in td.values():
                if not isinstance(nested, torch.Tensor):
                    nested.batch_size = torch.Size(())
        td[key] = made
    return WHOLE[whole](td)


def verdict(name: str, seen: Any) -> str | None:
    """What is wrong with how a planner takes ``seen``: any error but one of the project's own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        outcome = attempt(planner(name), seen)
    if outcome.foreign is not None:
        return outcome.foreign
    if outcome.refused is not None and (len(str(outcome.refused)) > 400 or not str(outcome.refused)):
        return f"the sentence has {len(str(outcome.refused))} letters"
    return None


def still_works(name: str) -> str | None:
    """Whether the planner still does what it did before any mistake."""
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        usual, found = _usual(name), planner(name)(good(name).clone())
    return None if torch.equal(usual, found["action"]) else "a mistake changed the planner"


@functools.cache
def _usual(name: str) -> torch.Tensor:
    return planner(name)(good(name).clone())["action"].clone()


def cases(draw: Random, folder: Path, count: int) -> Cases:
    """Mistakes at random, as many with each planner."""
    for name in PLANNERS:
        still_works(name)
        known = keys_of(name)
        for number in range(-(-count // len(PLANNERS))):
            changes = [
                (draw.choice(known), draw.choice([GONE, *ENTRIES])) for _ in range(draw.choice((0, 1, 1, 1, 2, 3)))
            ]
            whole = draw.choice(list(WHOLE)) if not changes or draw.random() < 0.1 else "as it is"
            try:
                seen = make_mistakes(name, changes, whole)
            except Exception:
                # The tensordict refuses it: no planner sees it.
                continue
            fault = verdict(name, seen)
            if fault is None and number % 100 == 99:
                fault = still_works(name)
            yield None if fault is None else f"{name}, {changes} {whole}: {fault}"


PROMISE = Promise(
    says="a mistake with a planner is told in one sentence of the project's own, and spoils nothing",
    cases=cases,
    count=12_000,
)
