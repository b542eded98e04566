"""Arrival times of joints: the closed form compared with Ruckig, in speed and in result.

    python benchmarks/arrival_time.py --out benchmarks/results/arrival_time.json

Ruckig is a separate library, ``pip install ruckig``; without it only our times are measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import tyro
from study import Output, Row, Study
from torch import Tensor

from torchdyn_plan.bench.timing import figures, sample
from torchdyn_plan.kinematics import UR5_SPEED_LIMIT
from torchdyn_plan.kinematics.timing import arrival_time
from torchdyn_plan.threads import one_thread

JOINTS, ACCELERATION = 6, 75.0
"""Of a UR5 as the tasks drive it; acceleration in rad/s²."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Which batches are measured."""

    batches: tuple[int, ...] = (1, 1024)
    """Goals at once."""
    cases: int = 2000
    """Cases that are compared with Ruckig."""
    seconds: float = 1.0
    """Time spent on each figure [s]."""


def draw(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Ways (count, N) [rad] and present speeds [rad/s], some of them over the limit, and the limits (N,)."""
    generator = torch.Generator().manual_seed(seed)
    offset = 2.0 * torch.rand(count, JOINTS, generator=generator, dtype=torch.float64) - 1.0
    scale = 10.0 ** (2.0 * torch.rand(count, 1, generator=generator, dtype=torch.float64) - 1.5)
    speed = torch.full((JOINTS,), float(UR5_SPEED_LIMIT), dtype=torch.float64)
    velocity = speed * (2.2 * torch.rand(count, JOINTS, generator=generator, dtype=torch.float64) - 1.1)
    # A third of the arms are at rest.
    velocity[::3] = 0.0
    return offset * scale, velocity, speed, torch.full_like(speed, ACCELERATION)


def ruckig_time(offset: Tensor, velocity: Tensor, speed: Tensor, acceleration: Tensor) -> Tensor:
    """The same by Ruckig, without a limit of jerk, a case at a time: ``(count,)`` [s]."""
    import ruckig

    otg, found = ruckig.Ruckig(JOINTS), []
    for way, now in zip(offset.tolist(), velocity.tolist(), strict=True):
        given, trajectory = ruckig.InputParameter(JOINTS), ruckig.Trajectory(JOINTS)
        given.current_position, given.current_velocity = [0.0] * JOINTS, now
        given.target_position, given.target_velocity = way, [0.0] * JOINTS
        given.max_velocity, given.max_acceleration = speed.tolist(), acceleration.tolist()
        otg.calculate(given, trajectory)
        found.append(trajectory.duration)
    return torch.tensor(found, dtype=torch.float64)


def compare(cases: int) -> Row:
    """What both say of the same cases."""
    given = draw(cases)
    ours, theirs = arrival_time(*given), ruckig_time(*given)
    error = (ours / theirs - 1.0).abs()
    return {
        "what": "difference",
        "cases": cases,
        "largest_share": error.max().item(),
        "mean_share": error.mean().item(),
    }


def measure(batch: int, seconds: float) -> Row:
    """How long the closed form takes for ``batch`` goals."""
    given = [value.float() for value in draw(batch)]
    times = figures(sample(lambda: arrival_time(*given), seconds=seconds), batch)
    return {"what": "arrival_time", "batch": batch, **times}


def main(arguments: Arguments) -> None:
    """Measure, and compare where Ruckig is installed."""
    study = Study(arguments, resume=False)
    with one_thread(), torch.no_grad():
        for batch in arguments.batches:
            study.add(measure(batch, arguments.seconds))
        try:
            study.add(compare(arguments.cases))
        except ImportError:
            study.add({"what": "difference", "cases": 0, "note": "ruckig is not installed"})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
