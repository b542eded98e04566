"""Latency and throughput of a re-plan, of its parts, and of a whole planner step around it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.bench.observations import Moments, moments
from torchdyn_plan.bench.replan_parts import Part, Parts, in_blocks, networks, replans, searches, static_steps, steps
from torchdyn_plan.bench.timing import figures, sample
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import DynamicPlanner, ExactSearch
from torchdyn_plan.tasks import DEFAULT, Task, load_task
from torchdyn_plan.threads import one_thread

BATCHES = (1, 16, 256, 1024, 4096, 16384)
"""Rows that plan at once."""
BLOCK = 1024
"""Rows that are worked on at a time on a processor, if there are more."""
SINGLES = 16
"""Rows of a batch that are compared with the same rows computed one by one."""
COARSE = 4
"""Of an exact search that is also timed from coarse to fine."""
COMPILED: dict[str, dict[str, Any]] = {"cpu": {"options": {"cpp_wrapper": True}}, "cuda": {"mode": "reduce-overhead"}}
"""How `torch.compile` is asked for little work around the kernels: calls from C++, or CUDA graphs."""
TRAINED, INFERENCE = "torchdyn_plan", "torchdyn_plan, for inference"
"""Implementations: the networks as they are trained, and their copies for inference."""


class Form(NamedTuple):
    """One thing that is timed."""

    about: dict[str, Any]
    """What a row of figures says of it."""
    planner: str
    """Name of the planner whose observations it reads."""
    part: Part
    """What is timed."""
    reference: Callable[..., Sequence[Tensor]]
    """What its results are compared with, row by row."""


def bench(
    task: Task | str = DEFAULT,
    *,
    planners: Mapping[str, DynamicPlanner] | Sequence[str] | None = None,
    batches: Sequence[int] = BATCHES,
    seconds: float = 0.4,
    compiled: bool = True,
) -> list[dict[str, Any]]:
    """A row for each device, batch, part and implementation.

    A row has the latency's median, 95th and 99th percentile, the throughput ``per_second``, and ``max_error``: the
    greatest difference from the same rows one by one, eager and with the networks as they are trained. A meeting may
    differ much where two are as good: rounding decides. Networks and the static planner are those of the first planner.

    Args:
        task: what the planners see is taken from its environment.
        planners: by name, or names of the task's own; for None its default ones that plan on what is seen.
        batches: rows that plan at once.
        seconds: time spent on each figure.
        compiled: also measure re-plans and networks compiled; each takes up to three compilations of a minute or less.

    Raises:
        InputError: a planner is no `DynamicPlanner`, or there is none.
    """
    from tqdm import tqdm

    task = load_task(task)
    made = _planners(task, planners)
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    rows = []
    several = torch._dynamo.config.patch(recompile_limit=64)  # The forms share code, and count together.
    with one_thread(), torch.no_grad(), several, tqdm(desc="re-plan", unit="figure", leave=False) as bar:
        whole = {name: moments(task, planner, name) for name, planner in made.items()}
        for device in devices:
            forms = _forms(
                {name: planner.to(device) for name, planner in made.items()}, whole, device, compiled=compiled
            )
            for batch in batches:
                seen = {name: one.repeated(batch).to(device) for name, one in whole.items()}
                for form in forms:
                    bar.set_postfix_str(f"{device}, batch {batch}, {form.about['what']}")
                    rows.append(_row(form, form.part.inputs(seen[form.planner]), batch, device, seconds))
                    bar.update()
    for planner in made.values():
        planner.to("cpu")
    return rows


def _planners(task: Task, planners: Mapping[str, Any] | Sequence[str] | None) -> dict[str, DynamicPlanner]:
    """The planners that are timed, by name."""
    if planners is None:
        return _default_planners(task)
    if isinstance(planners, str):
        raise InputError(f"planners must be a list of names or a mapping of planners, got the string {planners!r}")
    found = dict(planners) if isinstance(planners, Mapping) else {name: task.planner(name) for name in planners}
    if not found:
        raise InputError("planners must name one planner at least, got none")
    for name, planner in found.items():
        if not isinstance(planner, DynamicPlanner):
            raise InputError(f"only a DynamicPlanner plans again and again, but {name!r} is {type(planner).__name__}")
    return found


def _default_planners(task: Task) -> dict[str, DynamicPlanner]:
    """The task's default planners that plan on what is seen, and exact searches from coarse to fine."""
    found = {}
    for name in task.default_planners:
        planner = task.planner(name)
        if not isinstance(planner, DynamicPlanner) or keys.TARGET_FUTURE in planner.in_keys:
            continue
        found[name] = planner
        search = planner.search
        if isinstance(search, ExactSearch) and search.coarse == 1 and search.probability_weight == 0.0:
            found[f"{name}, coarse to fine"] = planner.with_parts(search=replace(search, coarse=COARSE))
    if not found:
        raise InputError(f"no default planner of {task.name} plans again and again: name one")
    return found


def _forms(
    planners: Mapping[str, DynamicPlanner], seen: Mapping[str, Moments], device: str, *, compiled: bool
) -> list[Form]:
    """Everything that is timed on ``device``."""
    plain = _planning(planners)
    light = _planning({name: planner.for_inference() for name, planner in planners.items()})
    alone = {name: searches(name, planner) | steps(name, planner, seen[name]) for name, planner in planners.items()}
    first = next(iter(planners))
    alone[first] |= static_steps(planners[first].static)
    forms: list[Form] = []

    def add(group: Mapping[str, Parts], implementation: str, change: Callable[..., Any] | None = None) -> None:
        for name, parts in group.items():
            for what, part in parts.items():
                about = {"what": what, "implementation": implementation, "compiled": change is not None}
                reference = plain[name].get(what, part).call
                timed = part if change is None else part._replace(call=change(part.call))
                forms.append(Form(about, name, timed, reference))

    add(plain, TRAINED)
    add(alone, TRAINED)
    add(light, INFERENCE)
    if compiled:
        add(light, INFERENCE, partial(torch.compile, fullgraph=True, **COMPILED[device]))
    return forms


def _planning(planners: Mapping[str, DynamicPlanner]) -> dict[str, Parts]:
    """What makes plans: all re-plans, and the networks of the first planner."""
    found = {name: replans(name, planner) for name, planner in planners.items()}
    first = next(iter(planners))
    return found | {first: networks(planners[first]) | found[first]}


def _row(form: Form, inputs: Sequence[Any], batch: int, device: str, seconds: float) -> dict[str, Any]:
    timed = partial(in_blocks, form.part.call, BLOCK) if device == "cpu" else form.part.call
    found = figures(sample(lambda: timed(*inputs), device=device, seconds=seconds), batch)
    place = {"batch": batch, "threads": torch.get_num_threads(), "device": device}
    error = max_error(timed, form.reference, inputs)
    return form.about | place | found | {"per_second": round(1e6 / found["per_item_us"]), "max_error": error}


def max_error(
    call: Callable[..., Sequence[Tensor]], reference: Callable[..., Sequence[Tensor]], inputs: Sequence[Any]
) -> float:
    """Greatest difference between the first rows of a batch and what ``reference`` makes of them one by one."""
    count = min(SINGLES, len(inputs[0]))
    singles = [reference(*(value[row : row + 1] for value in inputs)) for row in range(count)]
    pairs = zip(call(*inputs), map(torch.cat, zip(*singles, strict=True)), strict=True)
    return max(float((whole[: len(single)].double() - single.double()).abs().max()) for whole, single in pairs)
