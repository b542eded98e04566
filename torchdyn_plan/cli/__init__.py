"""The command line. What a command works with is imported when the command runs, so that help answers at once."""

import io
import os
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from torchdyn_plan.errors import InputError, TorchdynPlanError

PROGRAM = "torchdyn-plan"


def main(words: Sequence[str] | None = None) -> None:
    """Entry of ``torchdyn-plan``: exits 0 when done, 2 on a mistake in the arguments or the world, 130 on Ctrl-C."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal without "–" or "─" shows a question mark: a table is no reason to fail.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        _run(sys.argv[1:] if words is None else words)
        sys.stdout.flush()
    except BrokenPipeError:
        # Nobody reads on. Python flushes once more at exit: that goes to nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except TorchdynPlanError as error:
        print(f"{PROGRAM}: error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"{PROGRAM}: interrupted", file=sys.stderr)
        sys.exit(130)


def _run(words: Sequence[str]) -> None:
    """Parse ``words`` and run the command that they are."""
    try:
        import tyro
    except ImportError as error:
        raise TorchdynPlanError("the command line needs its extra: pip install 'torchdyn-plan[cli]'") from error
    from torchdyn_plan.cli import commands, forms
    from torchdyn_plan.cli.arguments import BenchArguments, TrainArguments
    from torchdyn_plan.tasks import load_task

    named, others = forms.task_of(words)
    task = load_task(named)
    if others[:1] == ["train"]:
        networks = forms.train_forms(task, named)
        network = _network(task.name, networks, others[1:])
        about = {"prog": f"{PROGRAM} train", "description": f"Train a network of {task.name}.", "args": others[1:]}
        parsed: Any = tyro.extras.subcommand_cli_from_dict(networks, **about)
        commands.train(task, network, parsed)
        return
    if others[:1] == ["bench"]:
        _check_benchmark(others[1:])
        about = {"prog": f"{PROGRAM} bench", "description": str(BenchArguments.__doc__), "args": others[1:]}
        parsed = tyro.extras.subcommand_cli_from_dict(forms.bench_forms(task, named), **about)
        # Planners know the tasks that they belong to, unless another one is asked for.
        commands.run(task if len(others) < len(words) else None, parsed)
        return
    choices: dict[str, Any] = {**forms.command_forms(task, named), "bench": BenchArguments, "train": TrainArguments}
    about = {"prog": PROGRAM, "description": "Planners for static targets, made to meet moving ones.", "args": others}
    commands.run(task, tyro.extras.subcommand_cli_from_dict(choices, **about))


def _check_benchmark(words: Sequence[str]) -> None:
    """Raise `InputError` if ``words`` begin with the name of a benchmark that there is not."""
    from torchdyn_plan.cli.arguments import BENCHMARKS

    if words and not words[0].startswith("-") and words[0] not in BENCHMARKS:
        from torchdyn_plan.checks import check_choice

        check_choice("benchmark", words[0], BENCHMARKS)


def _network(task: str, networks: Iterable[str], words: Sequence[str]) -> str:
    """The network that ``words`` name, empty for none; raises `InputError` if ``task`` has none of that name."""
    known, named = sorted(networks), words[0] if words and not words[0].startswith("-") else ""
    if not known:
        raise InputError(f"{task} has no network to train")
    if named and named not in known:
        raise InputError(f"unknown network of {task} {named!r}; choose from {', '.join(known)}")
    return named
