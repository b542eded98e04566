"""Inverse kinematics of many arms: solved share, limits, and CPU time beside a former checkout's.

    git worktree add /tmp/former 930dcd6
    python benchmarks/inverse.py --former /tmp/former --out inverse.json

Targets are poses of random joint positions within the limits, starts are other such positions. The two checkouts solve
the same in turn, in processes of their own on one thread; the CPU time is the least of ``repeats``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from arms import ARMS, make, positions
from study import Output, Row, Study, each, measuring

from torchdyn_plan.kinematics import Arm, constraint_error, solve_ik

HERE = Path(__file__).parent
TOLERANCES = 1e-3, 0.5 * torch.pi / 180.0


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Solve many arms' reachable poses."""

    arms: tuple[str, ...] = tuple(ARMS)
    """Names."""
    poses: int = 500
    """Reachable poses of each."""
    repeats: int = 3
    """Times that each is solved."""
    former: Path | None = None
    """Folder of another checkout, which solves the same."""
    side: bool = False
    """Serve as one side: names of arms come in, a line of JSON for each goes out."""


def solve(name: str, poses: int) -> Row:
    """One arm's poses: CPU time, and how many are solved, falsely told to be, or outside the limits."""
    arm = make(name)
    target, q0 = arm(positions(arm, poses, 1)), positions(arm, poses, 2)
    begin = time.process_time()
    result = solve_ik(arm, target, q0=q0)
    seconds = time.process_time() - begin
    solved = result.status == 0
    outside = ((result.q < arm.lower) | (result.q > arm.upper)).any(dim=-1)
    beyond = solve_ik(arm, arm(q0), q0=q0 + 7.0)
    beyond_outside = ((beyond.q < arm.lower) | (beyond.q > arm.upper)).any(dim=-1) & (beyond.status == 0)
    return {
        "solved": float(solved.double().mean()),
        "false": int((solved & ~_reached(arm, result.q, target)).sum()),
        "outside": int(outside.sum()),
        "outside_from_outside": int(beyond_outside.sum()),
        "seconds": seconds,
    }


def _reached(arm: Arm, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    error = constraint_error(arm(q), target)
    place, turn = error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)
    return (place <= 1.001 * TOLERANCES[0]) & (turn <= 1.001 * TOLERANCES[1])


class Side:
    """A process that solves with one checkout's package."""

    def __init__(self, checkout: Path, poses: int) -> None:
        """Start it."""
        env = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, str(HERE / "inverse.py"), "--side", "--poses", str(poses)]
        self.process = subprocess.Popen(command, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def solve(self, name: str) -> Row:
        """One arm, once."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{name}\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def end(self) -> None:
        """Stop it."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def serve(poses: int) -> None:
    """Solve what standard input asks for."""
    with measuring():
        solve("ur5", 4)
        for line in sys.stdin:
            print(json.dumps(solve(line.strip(), poses)), flush=True)


def best(rows: list[Row]) -> Row:
    """One row of several that differ in time alone."""
    return {**rows[0], "seconds": min(row["seconds"] for row in rows)}


def main(arguments: Arguments) -> None:
    """Solve, save and print."""
    if arguments.side:
        serve(arguments.poses)
        return
    checkouts: dict[str, Path] = {"now": HERE.parent}
    if arguments.former is not None:
        checkouts["former"] = arguments.former
    study = Study(arguments, resume=False)
    sides = {key: Side(checkout, arguments.poses) for key, checkout in checkouts.items()}
    for name in each(arguments.arms, "arms"):
        rows: dict[str, list[Any]] = {key: [] for key in sides}
        for _ in range(arguments.repeats):
            for key, side in sides.items():
                rows[key].append(side.solve(name))
        study.add({"arm": name, **{key: best(found) for key, found in rows.items()}})
    for side in sides.values():
        side.end()


if __name__ == "__main__":
    main(tyro.cli(Arguments))
