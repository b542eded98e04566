"""A tool that follows a smooth target: joint jumps, position and speed limits, compared with a warm-started solver.

    git worktree add /tmp/former 930dcd6
    python benchmarks/following.py --former /tmp/former --out following.json

Each target is a tool's pose along smooth joint motions, sums of sines within the position limits and at up to half of
the speed limits, so each can be followed without a jump. The solvers get the poses and the first joint positions.
``follow`` is run normally, and once more without speed limits, so that it may jump; ``solve_ik`` is called at every
step, from its last answer. With ``--tool`` the tool itself moves by sums of sines, and some of the paths cannot be
followed.

``jumps`` is the share of paths in which a joint moves by more than 0.8 rad in one step; ``detours`` the share in which
a joint has moved by more than 0.8 rad when the target is reached again after being lost for some steps: a jump within
speed limits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import tyro
from arms import ARMS, make, positions
from sides import Compared, in_turn, serve, started
from study import Row, Study, each
from torch import Tensor

from torchdyn_plan.kinematics import Arm, solve_ik

SIX = ("ur5", "puma", "panda", "iiwa", "rail and panda", "base and panda")
STEP = 0.02
"""Time between two poses [s]."""
JUMP = 0.8
"""[rad; m]"""


@dataclass(frozen=True, kw_only=True)
class Arguments(Compared):
    """Follow smooth targets."""

    arms: tuple[str, ...] = SIX
    """Names."""
    paths: int = 40
    """Targets of each."""
    steps: int = 150
    """Poses of each target, 0.02 s apart."""
    tool: bool = False
    """Let the tool move by sums of sines, and not the joints."""
    repeats: int = 2
    """Times that each is asked, in turn; the CPU time is the least."""


def targets(arm: Arm, paths: int, steps: int, *, tool: bool) -> tuple[Tensor, Tensor]:
    """Joint positions ``(P, N)`` at the start, and poses ``(P, T, 4, 4)``."""
    middle, half = 0.5 * (finite(arm)[0] + finite(arm)[1]), 0.5 * (finite(arm)[1] - finite(arm)[0])
    random = torch.Generator().manual_seed(3)
    draw = torch.rand(3, paths, 1, arm.num_joints, 2, generator=random, dtype=torch.float64).to(arm.lower)
    times = STEP * torch.arange(0, steps + 1, dtype=arm.lower.dtype).view(1, -1, 1, 1)
    rate, phase = 2.0 * math.pi * (0.1 + 0.4 * draw[0]), 2.0 * math.pi * draw[1]
    if not tool:
        # A joint's speed is at most the sum of amplitude times rate.
        most = torch.minimum(0.5 * half.unsqueeze(-1), 0.25 * arm.speed_limit.unsqueeze(-1) / rate)
        motion = (most * torch.sin(rate * times + phase)).sum(dim=-1)
        reach = motion.abs().amax(dim=1, keepdim=True)
        place = middle + (half - reach) * (2.0 * draw[2, :, :, :, 0] - 1.0)
        q = place + motion
        return q[:, 0], arm(q[:, 1:])
    q0 = middle + 0.8 * (positions(arm, paths, 1) - middle)
    rate, phase, size = rate[:, :, :3], phase[:, :, :3], draw[2, :, :, :3]
    waves = size * (torch.sin(rate * times[:, 1:] + phase) - torch.sin(phase))
    start = arm(q0)
    poses = start.unsqueeze(1).repeat(1, steps, 1, 1)
    poses[..., :3, 3] += 0.15 * waves[..., 0]
    poses[..., :3, :3] = rotation(0.5 * waves[..., 1]) @ start[:, None, :3, :3]
    return q0, poses


def finite(arm: Arm) -> tuple[Tensor, Tensor]:
    """Limits ``(N,)``, at half a turn at the most."""
    return arm.lower.clamp(min=-math.pi), arm.upper.clamp(max=math.pi)


def rotation(vector: Tensor) -> Tensor:
    """Rotations ``(*B, 3, 3)`` by axis times angle ``(*B, 3)`` [rad]."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3)))


def judged(arm: Arm, q0: Tensor, q: Tensor, status: Tensor, *, limited: bool) -> Row:
    """What a joint path ``(P, T, N)`` is like."""
    way = q.diff(dim=1, prepend=q0.unsqueeze(1)).abs()
    speed = (way / (arm.speed_limit * STEP)).amax(dim=-1)
    solved = status == 0
    row = {
        "jumps": share((way.amax(dim=-1) > JUMP).any(dim=1)),
        "detours": share(detours(q0, q, solved)),
        "unsolved": share(~solved),
        "outside": int(((q < arm.lower) | (q > arm.upper)).any(dim=-1).sum()),
    }
    return row | ({"too_fast": int((speed > 1.0 + 1e-9).sum()), "fastest": float(speed.max())} if limited else {})


def share(which: Tensor) -> float:
    """How many of all."""
    return float(which.double().mean())


def detours(q0: Tensor, q: Tensor, solved: Tensor) -> Tensor:
    """Which paths ``(P,)`` have a joint more than `JUMP` on between two solved steps with others between them."""
    found, last = torch.zeros(len(q), dtype=torch.bool), q0.clone()
    before = torch.ones(len(q), dtype=torch.bool)
    for here, is_solved in zip(q.unbind(1), solved.unbind(1), strict=True):
        found |= is_solved & ~before & ((here - last).abs().amax(dim=-1) > JUMP)
        last, before = torch.where(is_solved.unsqueeze(-1), here, last), is_solved
    return found


def warm_started(arm: Arm, q0: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
    """`solve_ik` at every step, from where it was."""
    q, found = q0, []
    for pose in poses.unbind(1):
        result = solve_ik(arm, pose, q0=q)
        q = result.q
        found.append((q, result.status))
    return torch.stack([one for one, _ in found], dim=1), torch.stack([one for _, one in found], dim=1)


def followed(arm: Arm, q0: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
    """`follow`."""
    from torchdyn_plan.kinematics import follow

    result = follow(arm, poses, q0, STEP)
    return result.q, result.status


def measured(line: str, arguments: Arguments) -> Row:
    """The row of ``arm|how``."""
    name, how = line.split("|")
    arm = (
        make(name) if how != "follow without speed limits" else Arm(ARMS[name](), speed_limit=1e6, dtype=torch.float64)
    )
    q0, poses = targets(make(name), arguments.paths, arguments.steps, tool=arguments.tool)
    ways: dict[str, Callable[..., Any]] = {"solve_ik": warm_started}
    begin = time.process_time()
    q, status = ways.get(how, followed)(arm, q0, poses)
    seconds = time.process_time() - begin
    return judged(arm, q0, q, status, limited=how == "follow") | {"seconds": seconds}


def main(arguments: Arguments) -> None:
    """Follow, save and print."""
    if arguments.side:
        serve(lambda line: measured(line, arguments))
        return
    study = Study(arguments, resume=False)
    words = ["--paths", str(arguments.paths), "--steps", str(arguments.steps), *(["--tool"] if arguments.tool else [])]
    sides = started("following.py", arguments.former, *words)
    for name in each(arguments.arms, "arms"):
        for how in ("follow", "follow without speed limits", "solve_ik"):
            asked = sides if how == "solve_ik" else {"now": sides["now"]}
            study.add({"arm": name, "how": how, **in_turn(asked, f"{name}|{how}", arguments.repeats)})
    for side in sides.values():
        side.close()


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
