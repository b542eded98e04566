"""What commands say. By then results are saved: that nobody listens is no reason to fail."""

import io
import os
import sys


def say(text: str) -> None:
    """Print ``text`` at once; from when nobody reads on, to nowhere."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        silence()


def silence() -> None:
    """Let whatever else is printed go nowhere, Python's last flush at exit included."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
