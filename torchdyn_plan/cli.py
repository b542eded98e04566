"""The command line. What a command works with is imported when the command runs, so that help answers at once."""

import importlib
import inspect
import io
import os
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

from torchdyn_plan.cli_arguments import (
    BENCHMARKS,
    BenchArguments,
    CollectArguments,
    EvaluateArguments,
    SweepArguments,
    TrainArguments,
)
from torchdyn_plan.errors import OutputError, TorchdynPlanError


def evaluate(arguments: EvaluateArguments) -> None:
    """Run the episodes, print the table and write the results."""
    from torchdyn_plan.checks import check_writable_folder

    if arguments.out is not None:
        check_writable_folder(arguments.out)
    from torchdyn_plan.evaluation import run

    run.evaluate(arguments)


def sweep(arguments: SweepArguments) -> None:
    """Run or continue the sweep and print its table."""
    from torchdyn_plan.evaluation import run
    from torchdyn_plan.evaluation.report import format_table
    from torchdyn_plan.evaluation.sweep import sweep

    print(format_table(sweep(arguments, run.run_points)))


def collect(arguments: CollectArguments) -> None:
    """Gather the data."""
    from torchdyn_plan.checks import check_writable_folder

    check_writable_folder(arguments.out)
    from torchdyn_plan.training import collect

    collect.collect(arguments)


def train(arguments: TrainArguments) -> None:
    """Fit the network, or go on where its folder stands."""
    from torchdyn_plan.checks import check_writable_folder

    check_writable_folder(arguments.out)
    if arguments.what in ("policy", "dher"):
        _train_policy(arguments)
        return
    from torchdyn_plan.training import fit, spread
    from torchdyn_plan.training.tasks import FIT_TASKS

    fits: dict[str, Callable[..., object]] = {
        "forecaster": fit.fit_forecaster, "eta": fit.fit_eta, "spread": spread.fit_spread,
    }  # fmt: skip
    tasks = {} if arguments.what == "spread" else {"task": FIT_TASKS[arguments.task]()}
    fits[arguments.what](arguments.data, arguments.out, **tasks, **arguments.settings())


def _train_policy(arguments: TrainArguments) -> None:
    if arguments.task == "reach":
        from torchdyn_plan.training.reach_policy import train_reach

        train_reach(arguments)
    else:
        from torchdyn_plan.training.policy import train_trapper

        train_trapper(arguments)


def bench(arguments: BenchArguments) -> None:
    """Measure, print the figures and write them."""
    from torchdyn_plan.checks import check_writable_folder
    from torchdyn_plan.files import write_json
    from torchdyn_plan.versions import library_versions, machine

    if arguments.out is not None:
        check_writable_folder(arguments.out.parent)
        if arguments.out.is_dir():
            raise OutputError(f"output file {str(arguments.out)!r} is a folder")
    benchmark = importlib.import_module(BENCHMARKS[arguments.name])
    compiled = {"compiled": arguments.compiled} if "compiled" in inspect.signature(benchmark.bench).parameters else {}
    rows = benchmark.bench(**compiled)
    for row in rows:
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    if arguments.out is not None:
        write_json(arguments.out, {"machine": machine(), "versions": library_versions(), "rows": rows})
        if hasattr(benchmark, "plot"):
            benchmark.plot(rows, arguments.out.with_suffix(".png"))


COMMANDS: dict[type, Callable[[Any], None]] = {
    EvaluateArguments: evaluate,
    SweepArguments: sweep,
    CollectArguments: collect,
    TrainArguments: train,
    BenchArguments: bench,
}
"""The arguments of each command, and the function that serves it."""

_POSITIONAL = (CollectArguments, TrainArguments, BenchArguments)
"""Commands whose first word says what they work on."""


def main(words: Sequence[str] | None = None) -> None:
    """Entry of ``torchdyn-plan``: exits 0 when done, 2 on a mistake in the arguments or the world, 130 on Ctrl-C."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal without "–" or "─" shows a question mark: a table is no reason to fail.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        arguments = _parse(words)
        COMMANDS[type(arguments)](arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # Nobody reads on. Python flushes once more at exit: that goes to nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except TorchdynPlanError as error:
        print(f"torchdyn-plan: error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("torchdyn-plan: interrupted", file=sys.stderr)
        sys.exit(130)


def _parse(words: Sequence[str] | None) -> object:
    try:
        import tyro
    except ImportError as error:
        raise TorchdynPlanError("the command line needs its extra: pip install 'torchdyn-plan[cli]'") from error
    forms: dict[str, Any] = {function.__name__: form for form, function in COMMANDS.items()}
    for name, form in forms.items():
        if form in _POSITIONAL:
            forms[name] = Annotated[form, tyro.conf.PositionalRequiredArgs]
    return tyro.extras.subcommand_cli_from_dict(
        forms,
        prog="torchdyn-plan",
        description="Planners for static targets, made to meet moving ones.",
        args=words,
    )
