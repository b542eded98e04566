"""Latency of a plan and of the steps around it, in this checkout and in another one, in one run.

    git worktree add /tmp/former 65afd9a
    python benchmarks/former_latency.py --former /tmp/former --out latency.json

Each checkout runs in its own processes, on one thread. Both are timed in alternating blocks, on the same recorded
observations at batch 1, so that other load on the machine affects both equally. A ratio is the median, over pairs of
blocks, of this checkout's median divided by the other's.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from former_latency_side import CALLS
from safetensors.torch import save_file
from sides import HERE, Answering
from study import Output, Row, Study, each, measuring

from torchdyn_plan import keys
from torchdyn_plan.tasks import load_task

SEEN = (
    keys.JOINT_POS,
    keys.JOINT_VEL,
    keys.TOOL_POS,
    keys.ROBOT_STATE,
    keys.TARGET_POS,
    keys.TARGET_HISTORY,
    keys.STEP_COUNT,
)
"""What Trapper's planners read of an observation."""
STEPS = 20
"""Control steps that are recorded: the first plan is made within them."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Time this checkout beside another one."""

    former: Path
    """Folder of the other checkout."""
    planners: tuple[str, ...] = ("corner_never", "wait_and_drop")
    """Trapper's planners; the corner planner of 65afd9a is called corner_never today."""
    statics: tuple[str, ...] = ("ik", "rl")
    """Static planners."""
    calls: tuple[str, ...] = tuple(CALLS)
    """What is timed."""
    processes: int = 5
    """Fresh processes of either checkout: where its code comes to lie is worth a percent or two."""
    rounds: int = 8
    """Blocks in each of them."""
    seconds: float = 0.1
    """Length of a block."""


def checkout_in(root: Path, observations: Path) -> Answering:
    """The checkout in ``root``, in a process of its own, ready for calls of its `Side`."""
    checkout = Answering(sys.executable, "former_latency_side.py", str(observations), package=root)
    package = Path(checkout.answer())
    if not package.is_relative_to(root):
        raise SystemExit(f"{root} was to be timed, but Python took {package}")
    return checkout


def record(file: Path) -> None:
    """Write what is seen of one ball from the beginning of its episode, while the arm holds still, to ``file``."""
    task = load_task("trapper")
    env = task.make_env(task.default_settings(), num_envs=1, seed=0, split="dev", num_threads=1)
    tensordict, seen = env.reset(), []
    for _ in range(STEPS):
        seen.append(tensordict.select(*SEEN))
        tensordict.set(keys.ACTION, torch.zeros(1, env.action_spec.shape[-1]))
        tensordict = env.step_and_maybe_reset(tensordict)[1]
    whole: Any = torch.stack(seen)
    save_file({key: whole[key].contiguous() for key in SEEN}, file)


def compare(observations: Path, planner: str, static: str, arguments: Arguments) -> Iterator[Row]:
    """A row for each call of one planner."""
    blocks: dict[str, list[tuple[float, float]]] = {call: [] for call in arguments.calls}
    same: dict[str, bool] = {}
    for _ in each(range(arguments.processes), f"{planner}, {static}"):
        here, there = (checkout_in(root.resolve(), observations) for root in (HERE.parent, arguments.former))
        prepared = [side.call("prepare", planner, static, "plan_compiled" in arguments.calls) for side in (here, there)]
        for name in ("plans", "actions"):
            same[f"same_{name}"] = same.get(f"same_{name}", True) and prepared[0][name] == prepared[1][name]
        for call in arguments.calls:
            for number in range(arguments.rounds):
                sides = (here, there) if number % 2 == 0 else (there, here)
                medians = {side: statistics.median(side.call("time", call, arguments.seconds)) for side in sides}
                blocks[call].append((medians[here], medians[there]))
        here.close()
        there.close()
    for call in arguments.calls:
        yield {"planner": planner, "static": static, "call": CALLS[call], **_figures(blocks[call]), **same}


def _figures(blocks: list[tuple[float, float]]) -> dict[str, float]:
    ratios = torch.tensor([here / there for here, there in blocks], dtype=torch.float64)
    low, median, high = torch.quantile(ratios, torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)).tolist()
    here, there = (statistics.median(values) for values in zip(*blocks, strict=True))
    values = {"us": here, "former_us": there, "ratio": median, "ratio_quartile_1": low, "ratio_quartile_3": high}
    return {name: round(value, 3) for name, value in values.items()}


def main(arguments: Arguments) -> None:
    """Time both checkouts, save and print."""
    study = Study(arguments, scene=load_task("trapper").digest(), resume=False)
    with tempfile.TemporaryDirectory() as folder, measuring():
        observations = Path(folder) / "observations.safetensors"
        record(observations)
        for planner in arguments.planners:
            for static in arguments.statics:
                for row in compare(observations, planner, static, arguments):
                    study.add(row)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
