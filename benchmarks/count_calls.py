"""Length of a step's path through the package: calls of its functions, their files, and changes of file.

    python benchmarks/count_calls.py --out calls.json --list

Every call of a Python function or method defined in ``torchdyn_plan`` is counted, as reported by ``sys.setprofile``.
Comprehensions, generator expressions and lambdas are not counted, because they have no name to look up; nor are calls
inside PyTorch, TensorDict, TorchRL or MuJoCo. A change of file is counted if a call is in another file than the
previous call.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import torch
import tyro
from study import Output, Study, measuring

import torchdyn_plan
from torchdyn_plan import keys
from torchdyn_plan.kinematics import Arm, solve_ik
from torchdyn_plan.planners import DynamicPlanner
from torchdyn_plan.tasks import DEFAULT, Task, load_task

ROOT = Path(torchdyn_plan.__file__).parent


class Call(NamedTuple):
    """One call of one of the package's functions."""

    file: str
    """Below the package's folder."""
    function: str
    """Its qualified name."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Follow some acts of the package live, and count their calls."""

    task: str = DEFAULT
    """Task whose planners and environment are followed."""
    planners: tuple[str, ...] = ("wait_and_drop", "corner")
    """Planners that plan again and again."""
    batch: int = 4
    """Environments side by side."""
    list: bool = False
    """Also print the calls in order."""


def follow(act: Callable[[], object]) -> list[Call]:
    """The calls of the package's functions while ``act`` runs, in order."""
    calls: list[Call] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        named = not code.co_name.startswith("<")
        if event == "call" and named and Path(code.co_filename).is_relative_to(ROOT):
            calls.append(Call(str(Path(code.co_filename).relative_to(ROOT)), code.co_qualname))

    sys.setprofile(note)
    try:
        act()
    finally:
        sys.setprofile(None)
    return calls


def count(calls: list[Call]) -> dict[str, int]:
    """Number of calls, of the files they stand in, and of changes from one file to another."""
    files = [call.file for call in calls]
    changes = sum(before != after for before, after in pairwise(files))
    return {"calls": len(files), "files": len(set(files)), "changes": changes}


def follow_planner(planner: Any, env: Any) -> dict[str, list[Call]]:
    """Calls of a step in which every row plans, and of the step after it, in which none does."""
    found: dict[str, list[Call]] = {}
    tensordict = env.reset()
    for _ in range(env.max_steps):
        calls = follow(lambda now=tensordict: planner(now))
        planned = tensordict[keys.PLAN]["replanned"]
        if planned.all():
            found["a step that plans"] = calls
        elif found and not planned.any():
            return found | {"a step between plans": calls}
        tensordict = env.step_and_maybe_reset(tensordict)[1]
    return found


def follow_env(env: Any) -> list[Call]:
    """Calls of one step of the environment, in the middle of its episodes."""
    tensordict = env.rand_action(env.reset())
    tensordict = env.rand_action(env.step_and_maybe_reset(tensordict)[1])
    return follow(lambda: env.step_and_maybe_reset(tensordict))


def follow_ik(batch: int) -> list[Call]:
    """Calls of `solve_ik` on poses that it is started at: what it costs beside its iterations."""
    arm = Arm.ur5(tool_length=0.084)
    q = 2.0 * torch.rand(batch, arm.num_joints, generator=torch.Generator().manual_seed(0)) - 1.0
    pose = arm(q)
    return follow(lambda: solve_ik(arm, pose, q0=q))


def acts(task: Task, planners: Sequence[str], batch: int) -> Iterator[tuple[str, list[Call]]]:
    """Every act by its name, and its calls."""
    env = task.make_env(task.default_settings(), num_envs=batch, seed=0, split="dev", num_threads=1)
    for name in planners:
        planner = task.planner(name)
        forms = {name: planner}
        if isinstance(planner, DynamicPlanner):
            forms[f"{name} in training mode"] = copy.deepcopy(planner).train()
        for form, one in forms.items():
            for what, calls in follow_planner(one, env).items():
                yield f"{form}, {what}", calls
    yield "a step of the environment", follow_env(env)
    yield "solve_ik at its solution", follow_ik(batch)


def main(arguments: Arguments) -> None:
    """Follow the acts, save and print."""
    task = load_task(arguments.task)
    study = Study(arguments, scene=task.digest(), resume=False)
    with measuring():
        for act, calls in acts(task, arguments.planners, arguments.batch):
            study.add({"act": act, **count(calls), "list": [list(call) for call in calls]})
            if arguments.list:
                print("".join(f"    {file:40} {function}\n" for file, function in calls))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
