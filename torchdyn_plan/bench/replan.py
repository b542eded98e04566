"""Latency and throughput of a re-plan, of its parts, and of a whole planner step around it."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchdyn_plan.bench.chosen import Choice, Chosen, Source
from torchdyn_plan.bench.observations import Moments, moments
from torchdyn_plan.bench.record import Record, Row
from torchdyn_plan.bench.replan_forms import COMPILED, Form, make_forms
from torchdyn_plan.bench.replan_parts import in_blocks
from torchdyn_plan.bench.timing import figures, sample
from torchdyn_plan.checks import check_choice, check_count, check_device, check_number, check_threads
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.episodes import Planner
from torchdyn_plan.progress import progress_bar
from torchdyn_plan.tasks import Task, load_task
from torchdyn_plan.threads import torch_threads
from torchdyn_plan.versions import usable_cores

BATCHES = (1, 1024)
"""Default batch sizes."""
SECONDS = 0.2
"""Default time spent on each figure [s]."""
LONGEST = 3600.0
"""Longest time allowed for a figure [s]."""
BLOCK = 1024
"""Rows processed at a time on a CPU."""
SINGLES = 16
"""Rows of a batch that are compared with the same rows computed one by one."""
NO_FIGURES = ("median_us", "p95_us", "p99_us", "per_item_us", "per_second", "max_error")
"""Entries that are None in a row that could not be measured."""


def bench(
    planner: Choice | None = None,
    *,
    task: Task | str | None = None,
    static: str | None = None,
    weights: str | Path | None = None,
    batches: Sequence[int] = BATCHES,
    seconds: float = SECONDS,
    threads: int = 1,
    device: torch.device | str = "cpu",
    compiled: bool = False,
    out: str | Path | None = None,
    progress: bool = True,
    show: Callable[[Row], object] | None = None,
) -> list[Row]:
    """A row for each batch, part and implementation.

    A row has the latency's median, 95th and 99th percentile, the throughput ``per_second``, and ``max_error``: the
    largest difference from the same rows computed one by one, eager and with the original networks. A meeting may
    differ a lot if two are equally good and rounding decides. On a CPU, more than `BLOCK` rows are processed in blocks.

    The planner's own code is timed: `DynamicPlanner.replan`, with its own search and models, and its steps. For other
    planners (baselines, planners for static goals) only the step is timed. Models and static planners shared by several
    planners are timed once; rows of parts that differ from the first planner's carry their planner's name. A row that
    cannot be measured has an ``error`` and no figures, for example a Python search that does not compile.

    Args:
        planner: a planner, planners by name, or names: of the task's planners, of a shipped one, of a folder with a
            planner, or ``package.module:NAME``. None for the task's default planners that make plans.
        task: task whose environment provides the observations; None for the task of each planner's scene, or the
            default one.
        static: static planner on which the task's planners are built; the default one for None.
        weights: folder of the networks of the task's planners, as written by ``train``; the shipped ones for None.
        batches: batch sizes.
        seconds: time spent on each figure.
        threads: torch threads, 0 for all cores; restored afterwards.
        device: where planners run, ``cpu`` or ``cuda``; restored afterwards.
        compiled: also measure compiled re-plans and networks; each needs up to three compilations of a minute or less.
        out: JSON file for the rows, written after each of them, so that a killed run leaves its rows. Another run
            starts from the beginning.
        progress: show a progress bar.
        show: called with each row once it is measured and saved.

    Raises:
        InputError: there is no such planner or device, a number is out of range, or a planner cannot act in the task.
        WeightsError: weights are missing or damaged.
        OutputError: the file cannot be written.
    """
    _check(batches, seconds, threads, device)
    threads, device = threads or usable_cores(), str(torch.device(device))
    known = None if task is None else load_task(task)
    record = Record(
        out,
        show=show,
        benchmark="replan",
        task=None if known is None else known.name,
        static=static,
        weights=None if weights is None else str(weights),
        batches=list(batches),
        seconds=seconds,
        threads=threads,
        device=device,
        compiled=compiled,
    )
    chosen = Source(task=known, static=static, weights=weights).choose(planner)
    record.about["config"]["planners"] = {name: one.task.name for name, one in chosen.items()}
    with ExitStack() as stack:
        stack.enter_context(torch_threads(threads))
        stack.enter_context(torch.no_grad())
        if compiled:
            # The forms share code, and count together.
            stack.enter_context(torch._dynamo.config.patch(recompile_limit=64))
        rows = _measure(chosen, batches, seconds, device, compiled=compiled, progress=progress)
        # Planners are moved back whatever happens.
        for row in stack.enter_context(closing(rows)):
            record.add(row)
    return record.end()


def _check(batches: Sequence[int], seconds: float, threads: int, device: torch.device | str) -> None:
    """Raise `InputError` for values out of range."""
    if not batches:
        raise InputError("batches must name at least one number of rows, got none")
    for batch in batches:
        check_count("batches", batch)
    check_number("seconds", seconds, minimum=0.0)
    if seconds > LONGEST:
        raise InputError(f"seconds must be <= {LONGEST:g}, got {seconds:g}")
    check_threads("threads", threads)
    check_device(device)
    check_choice("kind of device to measure on", torch.device(device).type, COMPILED)


def _measure(
    chosen: Mapping[str, Chosen],
    batches: Sequence[int],
    seconds: float,
    device: str,
    *,
    compiled: bool,
    progress: bool,
) -> Generator[Row]:
    """The rows, one after another."""
    planners = {name: one.planner for name, one in chosen.items()}
    with ExitStack() as stack:
        bar = stack.enter_context(progress_bar(desc="re-plan", unit="figure", leave=False, disable=not progress))
        for planner in planners.values():
            stack.enter_context(_stays(planner))
        whole: dict[str, Moments] = {}
        for name, (planner, task) in chosen.items():
            bar.set_postfix_str(f"{name} in episodes of {task.name}")
            _move(planner, "cpu")
            whole[name] = moments(task, planner, name)
            _move(planner, device)
        forms = make_forms(planners, whole, device, compiled=compiled)
        bar.reset(total=len(forms) * len(batches))
        failed: dict[int, str] = {}
        for batch in batches:
            seen = {name: one.repeated(batch).to(device) for name, one in whole.items()}
            for number, form in enumerate(forms):
                compiling = ", compiled" if form.about["compiled"] else ""
                bar.set_postfix_str(f"{device}, batch {batch}, {form.about['what']}{compiling}")
                known = failed.get(number)
                row = _row(form, seen[form.planner], known, batch=batch, device=device, seconds=seconds)
                if "error" in row and form.about["compiled"]:
                    failed[number] = row["error"]
                yield row
                bar.update()


@contextmanager
def _stays(planner: Planner) -> Iterator[None]:
    """Restores the device of ``planner`` on exit."""
    tensors = [*planner.parameters(), *planner.buffers()] if isinstance(planner, nn.Module) else []
    try:
        yield
    finally:
        if tensors:
            _move(planner, tensors[0].device)


def _move(planner: Planner, device: torch.device | str) -> None:
    """Bring ``planner`` to ``device``, if it is a module."""
    if isinstance(planner, nn.Module):
        planner.to(device)


def _row(form: Form, seen: Moments, error: str | None, *, batch: int, device: str, seconds: float) -> Row:
    """Figures of one form, or its ``error`` if it cannot be measured."""
    place = {"batch": batch, "threads": torch.get_num_threads(), "device": device}
    if error is None:
        try:
            return form.about | place | _figures(form, seen, batch=batch, device=device, seconds=seconds)
        except Exception as raised:
            lines = str(raised).splitlines() or [""]
            error = lines[0] if isinstance(raised, InputError) else f"{type(raised).__name__}: {lines[0]}"
    return form.about | place | dict.fromkeys(NO_FIGURES) | {"error": error}


def _figures(form: Form, seen: Moments, *, batch: int, device: str, seconds: float) -> Row:
    inputs, before = form.part.inputs(seen), form.part.before
    timed = partial(in_blocks, form.part.call, BLOCK) if device == "cpu" else form.part.call
    found = figures(sample(lambda: timed(*inputs), device=device, seconds=seconds, before=before), batch)
    error = max_error(timed, form.reference, inputs, before=before)
    if before is not None:
        before()
    return found | {"per_second": round(1e6 / found["per_item_us"]), "max_error": error}


def max_error(
    call: Callable[..., Sequence[Tensor]],
    reference: Callable[..., Sequence[Tensor]],
    inputs: Sequence[Any],
    *,
    before: Callable[[], object] | None = None,
) -> float:
    """Largest difference between the first rows of a batch and the results of ``reference`` for them one by one.

    ``before`` is called before each call.
    """
    prepare = before or (lambda: None)
    singles: list[Sequence[Tensor]] = []
    for row in range(min(SINGLES, len(inputs[0]))):
        prepare()
        singles.append(reference(*(value[row : row + 1] for value in inputs)))
    prepare()
    pairs = zip(call(*inputs), map(torch.cat, zip(*singles, strict=True)), strict=True)
    return max(_difference(whole[: len(single)].double(), single.double()) for whole, single in pairs)


def _difference(one: Tensor, other: Tensor) -> float:
    """Largest difference: 0 for equal values, including infinities and NaN; infinite if only one is not finite."""
    same = (one == other) | (one.isnan() & other.isnan())
    return float((one - other).abs().nan_to_num(torch.inf, torch.inf).masked_fill(same, 0.0).max())
