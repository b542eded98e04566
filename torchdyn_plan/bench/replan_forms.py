"""Everything that `torchdyn-plan bench replan` times of some planners: what is measured, in which implementation."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan.bench.observations import Moments
from torchdyn_plan.bench.record import Row
from torchdyn_plan.bench.replan_parts import Part, Parts, arrivals, forecasts, replans, searches, static_steps, steps
from torchdyn_plan.evaluation.episodes import Planner
from torchdyn_plan.planners import DynamicPlanner
from torchdyn_plan.planners.pretrained import describe_planner

COMPILED: dict[str, dict[str, Any]] = {"cpu": {"options": {"cpp_wrapper": True}}, "cuda": {"mode": "reduce-overhead"}}
"""How `torch.compile` is asked for little work around the kernels: calls from C++, or CUDA graphs."""
TRAINED, INFERENCE = "torchdyn_plan", "torchdyn_plan, for inference"
"""Implementations: the networks as they are trained, and their copies for inference."""


class Form(NamedTuple):
    """One thing that is timed."""

    about: Row
    """What a row of figures says of it."""
    planner: str
    """Name of the planner whose observations it reads."""
    part: Part
    """What is timed."""
    reference: Callable[..., Sequence[Tensor]]
    """What its results are compared with, row by row."""


def make_forms(
    planners: Mapping[str, Planner], seen: Mapping[str, Moments], device: str, *, compiled: bool
) -> list[Form]:
    """Everything that is timed on ``device``."""
    dynamic = {name: planner for name, planner in planners.items() if isinstance(planner, DynamicPlanner)}
    plain = _planning(dynamic, {name: _by_models(planner) for name, planner in dynamic.items()})
    light = _planning_for_inference(dynamic)
    alone: dict[str, Parts] = {}
    for name, planner in planners.items():
        alone[name] = searches(name, planner) if isinstance(planner, DynamicPlanner) else {}
        alone[name] |= steps(name, planner, seen[name])
    for name, label in _distinct(dynamic, "static"):
        alone[name] |= _labelled(static_steps(dynamic[name].static), label)
    forms: list[Form] = []

    def add(group: Mapping[str, Parts], implementation: str, change: Callable[..., Any] | None = None) -> None:
        for name, parts in group.items():
            for what, part in parts.items():
                about = {"what": what, "implementation": implementation, "compiled": change is not None}
                reference = plain.get(name, {}).get(what, part).call
                timed = part if change is None else part._replace(call=change(part.call))
                forms.append(Form(about, name, timed, reference))

    add(plain, TRAINED)
    add(alone, TRAINED)
    add(light, INFERENCE)
    if compiled:
        add(light, INFERENCE, partial(torch.compile, fullgraph=True, **COMPILED[torch.device(device).type]))
    return forms


def _by_models(planner: DynamicPlanner) -> DynamicPlanner:
    """The same planner, that plans by its models themselves."""
    made = copy.copy(planner)
    made.prepared = None
    return made


def _planning(planners: Mapping[str, DynamicPlanner], forms: Mapping[str, DynamicPlanner]) -> dict[str, Parts]:
    """What makes plans in these ``forms`` of ``planners``: all re-plans, and each model once."""
    found: dict[str, Parts] = {name: {} for name in forms}
    for part, parts_of in (("forecaster", forecasts), ("eta", arrivals)):
        for name, label in _distinct(planners, part):
            found[name] |= _labelled(parts_of(forms[name]), label)
    for name, planner in forms.items():
        found[name] |= replans(name, planner)
    return found


def _planning_for_inference(planners: Mapping[str, DynamicPlanner]) -> dict[str, Parts]:
    """What makes plans in copies of ``planners`` for inference; parts of one that has no copy raise why."""
    copies, failed = dict(planners), {}
    for name, planner in planners.items():
        try:
            copies[name] = planner.for_inference()
        except Exception as error:
            failed[name] = error
    found = _planning(planners, copies)
    for name, error in failed.items():
        found[name] = {what: part._replace(inputs=partial(_fail, error)) for what, part in found[name].items()}
    return found


def _fail(error: Exception, seen: Moments) -> tuple[Any, ...]:
    raise error


def _labelled(parts: Parts, label: str) -> Parts:
    """The same with ``label`` behind their names."""
    return {f"{what}{label}": part for what, part in parts.items()}


def _distinct(planners: Mapping[str, DynamicPlanner], part: str) -> list[tuple[str, str]]:
    """Planners whose ``part`` none before them has, and what tells their rows from those of the first."""
    found: dict[str, str] = {}
    for name, planner in planners.items():
        found.setdefault(_identity(planner, part), name)
    return [(name, f", {name}" if number else "") for number, name in enumerate(found.values())]


def _identity(planner: DynamicPlanner, part: str) -> str:
    """A text that is the same for equal parts: of one class, with equal settings and weights."""
    text = json.dumps(describe_planner(planner, _weights_digest)["parts"][part])
    # A person's own function is equal to itself alone.
    return str(id(getattr(planner, part))) if '"missing"' in text else text


def _weights_digest(network: Any) -> str:
    """Hash of the weights of a network."""
    digest = hashlib.sha256()
    for value in network.state_dict().values():
        digest.update(value.detach().cpu().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
