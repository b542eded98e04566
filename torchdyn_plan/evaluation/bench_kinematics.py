"""Kinematics of the UR5 beside other libraries': pose and Jacobian, five damped steps, solutions, planner steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.errors import CompileError
from torchdyn_plan.evaluation.bench_replan import observations
from torchdyn_plan.evaluation.play import one_thread
from torchdyn_plan.evaluation.plots import plot_bench
from torchdyn_plan.evaluation.rivals import DAMPING, Eaik, Mink, Pinocchio, PytorchKinematics, installed
from torchdyn_plan.evaluation.timing import figures, sample
from torchdyn_plan.kinematics import Arm, DampedSteps, compiled_pose_and_jacobian, solve_ik
from torchdyn_plan.planners import IKPlanner

BATCHES = (1, 64, 1024, 4096, 16384, 65536)
"""Rows at once."""
SOLVED_AT_ONCE = 1000
"""Reachable poses that are solved to 1 mm and 0.5°."""
CHECKED = 64
"""Rows of each result that are checked."""
POSE, STEPS, SOLUTION = "pose and Jacobian", "five damped steps", "solution"
PLANNER, CALL = "IKPlanner step", "IKPlanner call"

Row = dict[str, Any]


def bench(
    *, batches: Sequence[int] = BATCHES, seconds: float = 0.5, compiled: bool = True, rivals: bool = True
) -> list[Row]:
    """A row for each device, batch, task and implementation: its time, and how wrong its result is.

    ``max_error`` is the greatest difference of pose and Jacobian from those in float64; for steps and solutions, of the
    pose reached from its target; for the planner's action, from that in float64.

    Args:
        batches: rows at once.
        seconds: time spent on each figure.
        compiled: measure compiled forms too, where there is a compiler.
        rivals: measure the other libraries that are installed.
    """
    from tqdm import tqdm

    rows: list[Row] = []
    others = installed((PytorchKinematics, Pinocchio, Mink)) if rivals else []
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    with one_thread(), torch.no_grad(), tqdm(desc="kinematics", unit="figure", leave=False) as bar:
        for device in devices:
            own = _Own(device, compiled=compiled)
            for batch in batches:
                place = {"batch": batch, "device": device}
                for measured in (_own_rows(own, batch), _rival_rows(others, batch) if device == "cpu" else ()):
                    for one in measured:
                        rows.append(_row(*one, place, seconds))
                        bar.update()
        for one in _solutions(rivals=rivals):
            rows.append(_row(*one, {"batch": SOLVED_AT_ONCE, "device": "cpu"}, seconds))
            bar.update()
    return rows


plot = plot_bench

Measured = Iterator[tuple[Row, Callable[[], Any], Callable[[Any], Row]]]
"""What a row is about, what is timed, and what its result says of it."""


class _Own:
    """What this package has, in float32, eager and compiled where that can be had."""

    def __init__(self, device: str, *, compiled: bool) -> None:
        self.device, arm = device, Arm.ur5(device=device)
        self.arm, self.steps, self.planner = arm, DampedSteps(arm, damping=DAMPING), IKPlanner().to(device)
        self.forms: dict[bool, tuple[Any, Any, Any]] = {False: (arm.pose_and_jacobian, self.steps, self.planner)}
        if compiled:
            loops = compiled_pose_and_jacobian(arm), DampedSteps(arm, damping=DAMPING, compiled=True)
            planner = IKPlanner(compiled=True).to(device)
            q = torch.zeros(1, 6, device=device)
            try:
                loops[0](q)
                loops[1](q, arm(q))
                planner.step(q, q[:, :3])
            except CompileError:
                return
            self.forms[True] = (*loops, planner)


def _own_rows(own: _Own, batch: int) -> Measured:
    q, target = problem(batch)
    q, target = q.to(own.device), target.to(own.device)
    seen = observations(batch).to(own.device).exclude("plan")
    joint_pos, goal = seen["joint_pos"], seen["goal"]
    for compiled, (evaluate, steps, planner) in own.forms.items():
        about = {"implementation": "torchdyn_plan", "compiled": compiled}
        yield {"what": POSE, **about}, partial(evaluate, q), partial(_pose_error, q)
        yield {"what": STEPS, **about}, partial(steps, q, target), partial(_distance, target)
        yield (
            {"what": PLANNER, **about},
            partial(planner.step, joint_pos, goal),
            partial(_action_error, joint_pos, goal),
        )
        call = {"what": "IKPlanner call", **about}
        yield call, lambda planner=planner: planner(seen.copy())["action"], partial(_action_error, joint_pos, goal)


def _rival_rows(others: Sequence[Any], batch: int) -> Measured:
    q, target = problem(batch)
    for other in others:
        if batch <= other.most:
            about = {"implementation": other.name, "compiled": False}
            yield {"what": POSE, **about}, other.pose_and_jacobian(q), partial(_pose_error, q)
            yield {"what": STEPS, **about}, other.steps(q, target), partial(_distance, target)


def _solutions(*, rivals: bool) -> Measured:
    """Reachable poses from random starts."""
    random = torch.Generator().manual_seed(2)
    uniform = 2.0 * torch.rand(2, SOLVED_AT_ONCE, 6, generator=random, dtype=torch.float64) - 1.0
    arm, target = Arm.ur5(), Arm.ur5(dtype=torch.float64)(math.pi * uniform[0])
    single, q0 = target.float(), math.pi * uniform[1].float()
    about = {"what": SOLUTION, "implementation": "torchdyn_plan", "compiled": False}
    yield about, lambda: solve_ik(arm, single, q0=q0).q, partial(_solved, target)
    for other in installed((Eaik,)) if rivals else ():
        yield {**about, "implementation": other.name}, other.solve(target), partial(_solved, target)


def _row(about: Row, solve: Callable[[], Any], error: Callable[[Any], Row], place: Row, seconds: float) -> Row:
    quality = error(solve())
    durations = sample(solve, device=place["device"], seconds=seconds)
    threads = {"threads": torch.get_num_threads()}
    return about | place | threads | figures(durations, place["batch"]) | quality


def problem(batch: int) -> tuple[Tensor, Tensor]:
    """Configurations (B, 6) away from singularities, and poses (B, 4, 4) a tenth of a radian or less away."""
    random = torch.Generator().manual_seed(1)
    q = torch.tensor([0.0, -1.0, 1.3, 0.4, 1.2, 0.0]) + 0.4 * (2.0 * torch.rand(batch, 6, generator=random) - 1.0)
    near = q + 0.1 * (2.0 * torch.rand(batch, 6, generator=random) - 1.0)
    return q, Arm.ur5()(near)


def _doubles(value: Any) -> Tensor:
    """The first rows of a result, a tensor or a list of arrays, in float64."""
    rows = value[:CHECKED]
    if not isinstance(rows, Tensor):
        rows = torch.stack([torch.as_tensor(row) for row in rows])
    return rows.double().cpu()


def _pose_error(q: Tensor, result: Any) -> Row:
    pose, jacobian = Arm.ur5(dtype=torch.float64).pose_and_jacobian(_doubles(q))
    found = _doubles(result[0])[:, :3], _doubles(result[1])
    pairs = zip(found, (pose[:, :3], jacobian), strict=True)
    return {"max_error": max(float((one - other).abs().max()) for one, other in pairs)}


def _distance(target: Tensor, result: Any) -> Row:
    reached = Arm.ur5(dtype=torch.float64)(_doubles(result))
    return {"max_error": float((reached - _doubles(target)).abs().max())}


def _action_error(joint_pos: Tensor, goal: Tensor, result: Any) -> Row:
    action = result if isinstance(result, Tensor) else result[0]
    planner = IKPlanner(Arm.ur5(tool_length=IKPlanner().approach.tool_length, dtype=torch.float64))
    expected = planner.step(_doubles(joint_pos), _doubles(goal))[0]
    return {"max_error": float((_doubles(action) - expected).abs().max())}


def _solved(target: Tensor, q: Tensor) -> Row:
    reached, wanted = Arm.ur5(dtype=torch.float64)(q.double()), target.double()
    way = (reached - wanted)[:, :3, 3].norm(dim=-1)
    sine = 0.5 * torch.linalg.cross(reached[:, :3, :3], wanted[:, :3, :3], dim=-2).sum(dim=-1).norm(dim=-1)
    cosine = 0.5 * ((reached[:, :3, :3] * wanted[:, :3, :3]).sum(dim=(-2, -1)) - 1.0)
    solved = (way <= 1.001e-3) & (torch.atan2(sine, cosine) <= 1.001 * math.radians(0.5))
    return {"max_error": float((reached - wanted)[solved].abs().max()), "solved": float(solved.double().mean())}
