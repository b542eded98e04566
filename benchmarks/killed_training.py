"""A policy training killed with SIGKILL at random moments and resumed, beside one that was left alone.

python benchmarks/killed_training.py --rounds 40 --kills 3
"""

import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from safetensors.torch import load_file


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Both run the command of the command line with the same seed."""

    rounds: int = 40
    """Rounds of each training."""
    kills: int = 3
    """Times that one of them is killed."""
    wait: tuple[float, float] = (30.0, 70.0)
    """Shortest and longest time from a start to the kill [s]."""
    seed: int = 7
    """Of both trainings."""
    algorithm: str = "ddpg"
    """How they learn."""


def start(arguments: Arguments, out: Path) -> subprocess.Popen[bytes]:
    """`torchdyn-plan train policy` into ``out``."""
    run = [sys.executable, "-c", "from torchdyn_plan.cli import main; main()", "train", "policy", "--out", str(out)]
    settings = ["--steps", str(arguments.rounds), "--seed", str(arguments.seed), "--algorithm", arguments.algorithm]
    return subprocess.Popen([*run, *settings], stderr=subprocess.DEVNULL)


def main(arguments: Arguments) -> None:
    """Run both and compare every tensor of their last checkpoints; exits 1 where one differs."""
    with tempfile.TemporaryDirectory() as folder:
        whole, killed = Path(folder) / "whole", Path(folder) / "killed"
        start(arguments, whole).wait()
        for number in range(arguments.kills):
            process = start(arguments, killed)
            time.sleep(random.uniform(*arguments.wait))
            print(f"kill {number + 1}: {'running' if process.poll() is None else 'had ended'}")
            process.send_signal(signal.SIGKILL)
            process.wait()
        start(arguments, killed).wait()
        one, other = (load_file(out / "policy" / "checkpoint.safetensors") for out in (whole, killed))
    same = one.keys() == other.keys() and all(torch.equal(value, other[name]) for name, value in one.items())
    print(f"{len(one)} tensors, {'all equal' if same else 'NOT all equal'}")
    sys.exit(not same)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
