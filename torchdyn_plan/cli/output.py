"""What commands say. By then results are saved: that nobody listens is no reason to fail."""

import io
import os
import sys

from torchdyn_plan.errors import OutputError


def say(text: str) -> None:
    """Print ``text`` at once; from when nobody reads on, to nowhere. Raises `OutputError` if it cannot be written."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        silence()
    except OSError as error:
        silence()
        raise OutputError(f"cannot print: {error.strerror or error}") from error


def silence() -> None:
    """Let whatever else is printed go nowhere, Python's last flush at exit included."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
