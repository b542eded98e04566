"""Kinematics of the UR5 compared with other libraries: pose and Jacobian, damped steps, solutions, planner steps."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.bench.damped_steps import DampedSteps
from torchdyn_plan.bench.observations import pursued
from torchdyn_plan.bench.record import Record, Row
from torchdyn_plan.bench.rivals import DAMPING, Eaik, Mink, Pinocchio, PytorchKinematics, installed
from torchdyn_plan.bench.timing import figures, sample
from torchdyn_plan.errors import CompileError
from torchdyn_plan.evaluation.plots import plot_bench
from torchdyn_plan.kinematics import Arm, compiled_pose_and_jacobian, solve_ik
from torchdyn_plan.planners import IKPlanner
from torchdyn_plan.progress import progress_bar
from torchdyn_plan.tasks import DEFAULT, Task, load_task
from torchdyn_plan.threads import one_thread

BATCHES = (1, 64, 1024, 4096, 16384, 65536)
"""Rows at once."""
SOLVED_AT_ONCE = 1000
"""Reachable poses that are solved to 1 mm and 0.5°."""
CHECKED = 64
"""Rows of each result that are checked."""
POSE, STEPS, SOLUTION = "pose and Jacobian", "five damped steps", "solution"
PLANNER, CALL = "IKPlanner step", "IKPlanner call"


def bench(
    task: Task | str = DEFAULT,
    *,
    batches: Sequence[int] = BATCHES,
    seconds: float = 0.5,
    compiled: bool = True,
    rivals: bool = True,
    out: str | Path | None = None,
    progress: bool = True,
    show: Callable[[Row], object] | None = None,
) -> list[Row]:
    """A row for each device, batch, problem and implementation, with its time and the error of its result.

    ``max_error`` is the greatest difference of pose and Jacobian from those in float64; for steps and solutions, of the
    pose reached from its target; for the planner's action, from that in float64.

    Args:
        task: whose static planner is measured, if it is an `IKPlanner`; the other rows are the UR5's whatever the task.
        batches: rows at once.
        seconds: time spent on each figure.
        compiled: measure compiled forms too, where there is a compiler.
        rivals: measure the other libraries that are installed.
        out: JSON file for the rows, written with each of them.
        progress: show a progress bar.
        show: is given each row once it is measured and saved.

    Raises:
        OutputError: the file cannot be written.
    """
    task = load_task(task)
    about = {"task": task.name, "batches": list(batches), "seconds": seconds, "compiled": compiled}
    record = Record(out, show=show, benchmark="kinematics", **about)
    static = task.static_planner()
    planner = static if isinstance(static, IKPlanner) else None
    others = installed((PytorchKinematics, Pinocchio, Mink)) if rivals else []
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    bar = progress_bar(desc="kinematics", unit="figure", leave=False, disable=not progress)
    with one_thread(), torch.no_grad(), bar:
        for device in devices:
            own = _Own(device, planner, compiled=compiled)
            for batch in batches:
                place = {"batch": batch, "device": device}
                measured = [*_own_rows(own, batch)]
                if planner is not None:
                    measured += _planner_rows(own, planner, pursued(task, batch).to(device))
                if device == "cpu":
                    measured += _rival_rows(others, batch)
                for one in measured:
                    record.add(_row(*one, place, seconds))
                    bar.update()
        for one in _solutions(rivals=rivals):
            record.add(_row(*one, {"batch": SOLVED_AT_ONCE, "device": "cpu"}, seconds))
            bar.update()
    return record.end()


plot = plot_bench

Measured = Iterator[tuple[Row, Callable[[], Any], Callable[[Any], Row]]]
"""A row's description, the timed call, and what its result adds to the row."""


class _Own:
    """This package's implementations in float32: eager, and compiled (True) if there is a compiler."""

    def __init__(self, device: str, planner: IKPlanner | None, *, compiled: bool) -> None:
        self.device, self.arm = device, Arm.ur5(device=device)
        self.forms: dict[bool, tuple[Any, Any]] = {}
        self.forms[False] = self.arm.pose_and_jacobian, DampedSteps(self.arm, damping=DAMPING)
        self.planners: dict[bool, IKPlanner] = {}
        if planner is not None:
            self.planners[False] = copy.deepcopy(planner).to(device)
        if compiled:
            self._compile()

    def _compile(self) -> None:
        """Add the compiled forms, if there is a compiler."""
        arm, planner = self.arm, self.planners.get(False)
        evaluate, steps = compiled_pose_and_jacobian(arm), DampedSteps(arm, damping=DAMPING, compiled=True)
        q = torch.zeros(1, arm.num_joints, device=self.device)
        try:
            evaluate(q)
            steps(q, arm(q))
        except CompileError:
            return
        self.forms[True] = evaluate, steps
        if planner is not None:
            self.planners[True] = _compiled(planner)


def _compiled(planner: IKPlanner) -> IKPlanner:
    """The same planner, compiled."""
    device = planner.arm.lower.device
    settings: dict[str, Any] = {**planner.part_settings(), "compiled": True}
    made = IKPlanner(**settings).to(device)
    joint_pos = torch.zeros(1, planner.arm.num_joints, device=device)
    made.step(joint_pos, joint_pos[:, :3])
    return made


def _own_rows(own: _Own, batch: int) -> Measured:
    q, target = problem(batch)
    q, target = q.to(own.device), target.to(own.device)
    for compiled, (evaluate, steps) in own.forms.items():
        about = {"implementation": "torchdyn_plan", "compiled": compiled}
        yield {"what": POSE, **about}, partial(evaluate, q), partial(_pose_error, q)
        yield {"what": STEPS, **about}, partial(steps, q, target), partial(_distance, target)


def _planner_rows(own: _Own, planner: IKPlanner, seen: TensorDict) -> Measured:
    joint_pos, goal = seen[keys.JOINT_POS], seen[keys.GOAL]
    error = partial(_action_error, planner, joint_pos, goal)
    for compiled, one in own.planners.items():
        about = {"implementation": "torchdyn_plan", "compiled": compiled}
        yield {"what": PLANNER, **about}, partial(one.step, joint_pos, goal), error
        yield {"what": CALL, **about}, lambda one=one: one(seen.copy())[keys.ACTION], error


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


def _action_error(planner: IKPlanner, joint_pos: Tensor, goal: Tensor, result: Any) -> Row:
    action = result if isinstance(result, Tensor) else result[0]
    expected = copy.deepcopy(planner).double().step(_doubles(joint_pos), _doubles(goal))[0]
    return {"max_error": float((_doubles(action) - expected).abs().max())}


def _solved(target: Tensor, q: Tensor) -> Row:
    reached, wanted = Arm.ur5(dtype=torch.float64)(q.double()), target.double()
    way = (reached - wanted)[:, :3, 3].norm(dim=-1)
    sine = 0.5 * torch.linalg.cross(reached[:, :3, :3], wanted[:, :3, :3], dim=-2).sum(dim=-1).norm(dim=-1)
    cosine = 0.5 * ((reached[:, :3, :3] * wanted[:, :3, :3]).sum(dim=(-2, -1)) - 1.0)
    solved = (way <= 1.001e-3) & (torch.atan2(sine, cosine) <= 1.001 * math.radians(0.5))
    return {"max_error": float((reached - wanted)[solved].abs().max()), "solved": float(solved.double().mean())}
