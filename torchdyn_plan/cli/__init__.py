"""The command line. What a command works with is imported when the command runs, so that help answers at once."""

import contextlib
import io
import sys
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any, NoReturn

from torchdyn_plan.cli.output import silence
from torchdyn_plan.errors import InputError, TorchdynPlanError
from torchdyn_plan.stopping import Terminated, terminable

PROGRAM = "torchdyn-plan"
FILES = {".json", ".mp4", ".gif", ".webp", ".png"}
"""Endings of files that commands write; other names are of folders."""


def main(words: Sequence[str] | None = None) -> None:
    """Entry of ``torchdyn-plan``.

    Exits 0 when done, 2 on a mistake in the arguments or the world, 130 on Ctrl-C and 143 on SIGTERM.
    """
    for stream in (sys.stdout, sys.stderr):
        # A terminal without "–" or "─" shows a question mark: a table is no reason to fail.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        with terminable():
            _run(sys.argv[1:] if words is None else words)
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        silence()
    except (TorchdynPlanError, OSError, MemoryError) as error:
        _fail(2, f"error: {_in_one_line(error)}")
    except RuntimeError as error:
        # PyTorch's own way of saying it.
        if "not enough memory" not in str(error) and "out of memory" not in str(error):
            raise
        _fail(2, f"error: {_in_one_line(error)}")
    except Terminated:
        _fail(143, "terminated")
    except KeyboardInterrupt:
        _fail(130, "interrupted")


def _fail(code: int, text: str) -> NoReturn:
    """Say ``text`` in a line and exit with ``code``, whoever listens."""
    if code == 2 and sys.stdout is not None:
        try:
            sys.stdout.flush()
        except OSError:
            silence()
    with contextlib.suppress(OSError):
        print(f"{PROGRAM}: {text}", file=sys.stderr, flush=True)
    sys.exit(code)


def _in_one_line(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return "not enough memory"
    return " ".join(str(error).split()) or type(error).__name__


def _run(words: Sequence[str]) -> None:
    """Parse ``words`` and run the command that they are; folders made for it go again if nothing was written there."""
    try:
        import tyro
    except ImportError as error:
        raise TorchdynPlanError("the command line needs its extra: pip install 'torchdyn-plan[cli]'") from error
    from torchdyn_plan.cli import commands, forms
    from torchdyn_plan.cli.arguments import BenchArguments, TrainArguments
    from torchdyn_plan.tasks import load_task

    forms.check_words(words)
    named, scene, others = forms.task_of(words)
    task = load_task(named, scene)
    if others[:1] == ["train"]:
        networks = forms.train_forms(task, named)
        network = _network(task.name, networks, others[1:])
        about = {"prog": f"{PROGRAM} train", "description": f"Train a network of {task.name}.", "args": others[1:]}
        parsed: Any = tyro.extras.subcommand_cli_from_dict(networks, **about)
        parsed = commands.with_folders(task, parsed)
        with _unless_in_vain(parsed):
            commands.train(task, network, parsed)
        return
    if others[:1] == ["bench"]:
        _check_benchmark(others[1:])
        about = {"prog": f"{PROGRAM} bench", "description": str(BenchArguments.__doc__), "args": others[1:]}
        parsed = tyro.extras.subcommand_cli_from_dict(forms.bench_forms(task, named), **about)
        with _unless_in_vain(parsed):
            # Planners know the tasks that they belong to, unless another one is asked for.
            commands.run(task if len(others) < len(words) else None, parsed)
        return
    choices: dict[str, Any] = {**forms.command_forms(task, named), "bench": BenchArguments, "train": TrainArguments}
    about = {"prog": PROGRAM, "description": "Planners for static targets, made to meet moving ones.", "args": others}
    parsed = commands.with_folders(task, tyro.extras.subcommand_cli_from_dict(choices, **about))
    # A report is of all tasks, unless one is asked for.
    all_tasks = others[:1] == ["report"] and len(others) == len(words)
    with _unless_in_vain(parsed):
        commands.run(None if all_tasks else task, parsed)


def _unless_in_vain(arguments: Any) -> AbstractContextManager[None]:
    """Remove folders that are made for ``arguments.out`` meanwhile, if an error leaves them empty."""
    from torchdyn_plan.files import no_empty_folders

    out = arguments.out
    return contextlib.nullcontext() if out is None else no_empty_folders(out.parent if out.suffix in FILES else out)


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
