"""What each command does; what it works with is imported when it runs."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdyn_plan.cli.arguments import (
    BENCHMARKS,
    DATA,
    Arguments,
    BenchArguments,
    CollectArguments,
    EpisodeArguments,
    EvaluateArguments,
    FitArguments,
    PolicyArguments,
    SweepArguments,
    TrainArguments,
)
from torchdyn_plan.errors import InputError, OutputError
from torchdyn_plan.tasks import Task

if TYPE_CHECKING:
    from torchdyn_plan.planners import Delivery


def run(task: Task, arguments: Arguments) -> None:
    """Run the command that takes these arguments."""
    command = next(function for form, function in COMMANDS.items() if isinstance(arguments, form))
    command(task, arguments)


def evaluate(task: Task, arguments: EvaluateArguments) -> None:
    """Run the episodes, write the results and print the table."""
    from torchdyn_plan.checks import check_writable_folder
    from torchdyn_plan.evaluation import evaluate

    task.default_settings(**asdict(arguments.settings))
    if arguments.out is not None:
        check_writable_folder(arguments.out)
    found = evaluate(task, arguments.planners, **_shared(task, arguments))
    if arguments.out is not None:
        found.save(arguments.out)
    print(found.table())
    if arguments.out is not None:
        print(f"\nwritten: {', '.join(str(path) for path in sorted(arguments.out.iterdir()))}")


def sweep(task: Task, arguments: SweepArguments) -> None:
    """Run or continue the sweep and print its table."""
    from torchdyn_plan.evaluation.report import format_table
    from torchdyn_plan.evaluation.sweep import sweep

    rows = sweep(
        task,
        arguments.planners,
        over=arguments.over,
        out=arguments.out,
        values=arguments.values,
        repeats=arguments.repeats,
        **_shared(task, arguments),
    )
    print(format_table(task, rows))


def collect(task: Task, arguments: CollectArguments) -> None:
    """Gather the data."""
    from torchdyn_plan.checks import check_writable_folder

    check_writable_folder(arguments.out)
    from torchdyn_plan.training.collect import collect

    collect(
        task,
        arguments.what,
        arguments.out,
        episodes=arguments.episodes,
        seed=arguments.seed,
        num_envs=arguments.num_envs,
        num_threads=arguments.threads,
        static=arguments.static,
        weights=arguments.weights,
    )


def train(task: Task, network: str, arguments: TrainArguments) -> None:
    """Train the network, or go on where its folder stands."""
    from torchdyn_plan.checks import check_writable_folder

    check_writable_folder(arguments.out)
    from torchdyn_plan.training.train import train

    own: dict[str, Any] = {}
    if isinstance(arguments, PolicyArguments):
        own["options"] = task.policies[network].options(**asdict(arguments.training))
        own |= {"num_envs": arguments.num_envs, "num_threads": arguments.threads, "workers": arguments.workers}
        own["algorithm"] = arguments.algorithm
    train(
        task,
        network,
        arguments.data if isinstance(arguments, FitArguments) else DATA,
        arguments.out,
        steps=arguments.steps,
        batch=arguments.batch,
        lr=arguments.lr,
        seed=arguments.seed,
        device=arguments.device,
        resume=arguments.resume,
        **own,
    )


def bench(task: Task, arguments: BenchArguments) -> None:
    """Measure, write the figures and print them."""
    from torchdyn_plan.checks import check_choice
    from torchdyn_plan.files import write_json
    from torchdyn_plan.versions import library_versions, machine

    check_choice("benchmark", arguments.name, BENCHMARKS)
    _check_file(arguments.out)
    benchmark = importlib.import_module(BENCHMARKS[arguments.name])
    takes = inspect.signature(benchmark.bench).parameters
    given = {"task": task, "compiled": arguments.compiled}
    rows = benchmark.bench(**{name: value for name, value in given.items() if name in takes})
    if arguments.out is not None:
        write_json(arguments.out, {"machine": machine(), "versions": library_versions(), "rows": rows})
        if hasattr(benchmark, "plot"):
            benchmark.plot(rows, arguments.out.with_suffix(".png"))
    for row in rows:
        print("  ".join(f"{name} {value}" for name, value in row.items()))


COMMANDS: dict[type[Arguments], Callable[[Task, Any], None]] = {
    EvaluateArguments: evaluate,
    SweepArguments: sweep,
    CollectArguments: collect,
    BenchArguments: bench,
}
"""The arguments of each command but ``train``, and the function that serves it."""


def _check_file(out: Path | None) -> None:
    """Raise `OutputError` unless a file can be written at ``out``."""
    from torchdyn_plan.checks import check_writable_folder

    if out is None:
        return
    check_writable_folder(out.parent)
    if out.is_dir():
        raise OutputError(f"output file {str(out)!r} is a folder")


def _shared(task: Task, arguments: EpisodeArguments) -> dict[str, Any]:
    """What evaluations and sweeps are given alike."""
    return {
        "static": arguments.static,
        "episodes": arguments.episodes,
        "seed": arguments.seed,
        "split": arguments.split,
        "num_envs": arguments.num_envs,
        "num_threads": arguments.threads,
        "delivery": _delivery(task, arguments),
        "weights": arguments.weights,
        **asdict(arguments.settings),
    }


def _delivery(task: Task, arguments: EpisodeArguments) -> Delivery | None:
    """How plans come late; None if they do not."""
    from torchdyn_plan.checks import check_number
    from torchdyn_plan.planners import Delayed

    check_number("latency_ms", arguments.latency_ms, minimum=0.0)
    step_ms = 1000 * task.control_step
    steps = round(arguments.latency_ms / step_ms)
    # A millionth of a step is rounding.
    if abs(arguments.latency_ms / step_ms - steps) > 1e-6:
        raise InputError(f"latency_ms must be whole control steps of {step_ms:g} ms, got {arguments.latency_ms:g}")
    return Delayed(steps, compensate=arguments.compensate) if steps else None
