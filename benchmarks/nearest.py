"""The nearest IK solution on the UR5, compared with the nearest of all analytic solutions; and the cost of `branches`.

    pip install eaik
    git worktree add /tmp/former 930dcd6
    python benchmarks/nearest.py --former /tmp/former --out nearest.json

EAIK finds all solutions of each target; each is shifted by 2π to be nearest to the start within the limits, and the
nearest of them is the one whose slowest joint arrives first. An answer counts as nearest if it takes at most 0.01 s
longer; ``extra`` is the mean extra time, ``worst`` the largest [s].
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
import tyro
from arms import positions
from sides import Compared, in_turn, serve, started
from study import Row, Study, measuring
from torch import Tensor

from torchdyn_plan.bench.rivals import Eaik
from torchdyn_plan.bench.timing import sample
from torchdyn_plan.kinematics import Arm, solve_ik

HOME = 0.0, -1.0, 1.3, 0.4, 1.2, 0.0
"""Joint positions [rad]."""
CASES = "home ± 1 rad", "any to any"
HOWS: dict[str, dict[str, Any]] = {
    "solve_ik": {},
    "solve_ik, 16 starts": {"rounds": (16,)},
    "solve_ik, solutions=8": {"solutions": 8},
}
NEAR = 0.01
"""[s]"""


@dataclass(frozen=True, kw_only=True)
class Arguments(Compared):
    """Solve poses of the UR5 from given starts."""

    poses: int = 1000
    """Reachable poses of each case."""
    seconds: float = 1.0
    """Time spent on each figure of speed."""


def problem(arm: Arm, case: str, poses: int) -> tuple[Tensor, Tensor]:
    """Starts ``(P, 6)`` and the joint positions ``(P, 6)`` of targets."""
    if case == CASES[1]:
        return positions(arm, poses, 1), positions(arm, poses, 2)
    random = torch.Generator().manual_seed(1)
    spread = 2.0 * torch.rand(2, poses, 6, generator=random, dtype=torch.float64) - 1.0
    start, end = torch.tensor(HOME, dtype=torch.float64) + spread
    return start, end


def travel(arm: Arm, q: Tensor, start: Tensor) -> Tensor:
    """Time [s] of the slowest joint."""
    return ((q - start).abs() / arm.speed_limit).amax(dim=-1)


def least_travel(arm: Arm, eaik: Eaik, target: Tensor, start: Tensor) -> Tensor:
    """Time ``(P,)`` [s] to the nearest of all solutions."""
    least = []
    for pose, place in zip(target, start, strict=True):
        q = exact(eaik, pose)
        turns = torch.arange(-2, 3, dtype=torch.float64).view(-1, 1, 1) * (2.0 * torch.pi)
        ways = (q + turns - place).abs() / arm.speed_limit
        outside = (q + turns < arm.lower) | (q + turns > arm.upper)
        least.append(ways.masked_fill(outside, torch.inf).amin(dim=0).amax(dim=-1).min())
    return torch.stack(least)


def exact(eaik: Eaik, pose: Tensor) -> Tensor:
    """All solutions ``(K, 6)`` of a pose; what is a least square alone does not reach it."""
    found = eaik.robot.IK(pose.numpy())
    return torch.from_numpy(found.Q[[not is_square for is_square in found.is_LS]]).view(-1, 6)


def measured(line: str, poses: int) -> Row:
    """The row of ``case|how``."""
    case, how = line.split("|")
    arm, eaik = Arm.ur5(dtype=torch.float64), Eaik()
    start, end = problem(arm, case, poses)
    target = arm(end)
    begin = time.process_time()
    result = solve_ik(arm, target, q0=start, **HOWS[how])
    seconds = time.process_time() - begin
    q, status = (value[:, 0] if "solutions" in HOWS[how] else value for value in result[:2])
    extra = travel(arm, q, start) - least_travel(arm, eaik, target, start)
    return {
        "solved": float((status == 0).double().mean()),
        "nearest": float((extra <= NEAR).double().mean()),
        "extra": float(extra.mean()),
        "worst": float(extra.max()),
        "seconds": seconds,
    }


def speed(poses: int, seconds: float) -> Row:
    """Time a pose [µs] of all solutions at once, the median and the least, and whether they are EAIK's."""
    from torchdyn_plan.kinematics import branches

    arm, eaik = Arm.ur5(dtype=torch.float64), Eaik()
    target, single = arm(positions(arm, poses, 1)), Arm.ur5()
    rows, narrow = target.numpy(), target.float()
    ways: dict[str, Callable[[], object]] = {
        "branches, float32": lambda: branches(single, narrow),
        "branches, float64": lambda: branches(arm, target),
        "EAIK": lambda: [eaik.robot.IK(one) for one in rows],
    }
    row: Row = {}
    for name, solve in ways.items():
        times = sample(solve, seconds=seconds)
        row |= {name: 1e6 * median(times) / poses, f"{name}, least": 1e6 * min(times) / poses}
    found = branches(arm, target)
    theirs = [exact(eaik, pose) for pose in target]
    row["of_theirs_found"] = float(
        torch.cat([_found(*one) for one in zip(theirs, found.q, found.valid, strict=True)]).mean()
    )
    row["solutions"] = float(found.valid.sum(dim=1).double().mean())
    row["solutions, EAIK"] = sum(map(len, theirs)) / poses
    row["max_error"] = float((arm(found.q) - target.unsqueeze(1)).abs().amax(dim=(-2, -1))[found.valid].max())
    return row


def _found(theirs: Tensor, ours: Tensor, valid: Tensor) -> Tensor:
    """Which of theirs ``(K, 6)`` are among ours ``(8, 6)``, as float64."""
    way = theirs.unsqueeze(1) - ours[valid]
    way = way - 2.0 * torch.pi * (way / (2.0 * torch.pi)).round()
    return (way.abs().amax(dim=-1) < 1e-5).any(dim=1).double()


def main(arguments: Arguments) -> None:
    """Solve, save and print."""
    if arguments.side:
        serve(lambda line: measured(line, arguments.poses))
        return
    study = Study(arguments, resume=False)
    sides = started("nearest.py", arguments.former, "--poses", str(arguments.poses))
    for case in CASES:
        for how, options in HOWS.items():
            asked = {"now": sides["now"]} if "solutions" in options else sides
            study.add({"case": case, "how": how, **in_turn(asked, f"{case}|{how}", arguments.repeats)})
    for side in sides.values():
        side.close()
    with measuring():
        study.add({"case": "all solutions [µs a pose]", **speed(arguments.poses, arguments.seconds)})


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
