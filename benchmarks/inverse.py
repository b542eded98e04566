"""Inverse kinematics of many arms: solved share, limits, and CPU time compared with a former checkout.

    git worktree add /tmp/former 930dcd6
    python benchmarks/inverse.py --former /tmp/former --out inverse.json

Targets are poses of random joint positions within the limits, and starts are other such positions. Further starts are
at the target but outside the limits, by 7 rad or by 1e-4 rad. The two checkouts solve the same problems in turn, in
their own processes on one thread; the CPU time is the minimum of ``repeats``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
import tyro
from arms import ARMS, make, positions
from sides import Compared, in_turn, serve, started
from study import Row, Study, each

from torchdyn_plan.kinematics import Arm, constraint_error, solve_ik

TOLERANCES = 1e-3, 0.5 * torch.pi / 180.0


@dataclass(frozen=True, kw_only=True)
class Arguments(Compared):
    """Solve many arms' reachable poses."""

    arms: tuple[str, ...] = tuple(ARMS)
    """Names."""
    poses: int = 500
    """Reachable poses of each."""


def solve(name: str, poses: int) -> Row:
    """One arm's poses: CPU time, and how many are solved, falsely told to be, or outside the limits."""
    arm = make(name)
    target, q0 = arm(positions(arm, poses, 1)), positions(arm, poses, 2)
    solve_ik(arm, target[:1], q0=q0[:1])
    begin = time.process_time()
    result = solve_ik(arm, target, q0=q0)
    seconds = time.process_time() - begin
    solved = result.status == 0
    # At the upper limits and just above them, and far outside.
    starts = torch.cat([q0 + 7.0, torch.minimum(q0 + 7.0, arm.upper) + 1e-4])
    beyond = solve_ik(arm, arm(starts), q0=starts)
    return {
        "solved": float(solved.double().mean()),
        "false": int((solved & ~_reached(arm, result.q, target)).sum()),
        "outside": int(_outside(arm, result.q).sum()),
        "outside_from_outside": int((_outside(arm, beyond.q) & (beyond.status == 0)).sum()),
        "seconds": seconds,
    }


def _reached(arm: Arm, q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    error = constraint_error(arm(q), target)
    place, turn = error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)
    return (place <= 1.001 * TOLERANCES[0]) & (turn <= 1.001 * TOLERANCES[1])


def _outside(arm: Arm, q: torch.Tensor) -> torch.Tensor:
    return ((q < arm.lower) | (q > arm.upper)).any(dim=-1)


def main(arguments: Arguments) -> None:
    """Solve, save and print."""
    if arguments.side:
        serve(lambda name: solve(name, arguments.poses))
        return
    study = Study(arguments, resume=False)
    sides = started("inverse.py", arguments.former, "--poses", str(arguments.poses))
    for name in each(arguments.arms, "arms"):
        study.add({"arm": name, **in_turn(sides, name, arguments.repeats)})
    for side in sides.values():
        side.close()


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
