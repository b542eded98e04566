"""What a re-plan costs with the networks trained with noise, beside the ones trained without, in the same run.

    python benchmarks/noisy_replan.py --out benchmarks/results/noisy_replan.json

Both plan on the same tracks of a noisy sensor. Blocks of calls alternate, and ``ratio`` is the median over the blocks
of the noisy networks' median duration over that of the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

import torch
import tyro
from sensors import SENSORS, sees_by
from study import Output, Row, Study, measuring
from tensordict import TensorDict, TensorDictBase

from torchdyn_plan import keys
from torchdyn_plan.bench.observations import observe
from torchdyn_plan.bench.replan_parts import flat_replan
from torchdyn_plan.bench.timing import sample
from torchdyn_plan.nets import ForecastByNoise
from torchdyn_plan.planners import DynamicPlanner, Plan
from torchdyn_plan.tasks import load_task

TASK, SENSOR = "trapper", "5 mm, 60 Hz, 20 ms late"
STEPS, EPISODES = 40, 64
"""Control steps after which all of so many episodes plan."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """What is timed."""

    batches: tuple[int, ...] = (1, 1024)
    """Rows that plan at once."""
    blocks: int = 40
    """Blocks of calls of each kind."""
    seconds: float = 0.1
    """Time spent on a block [s]."""


def tracked() -> TensorDictBase:
    """What a planner behind a track reads, in the middle of `EPISODES` episodes."""
    task, sensor = load_task(TASK), SENSORS[SENSOR]
    seeing = sees_by(task.planner("wait_and_drop"), "kalman", sensor, task.control_step)
    env = task.make_env(task.default_settings(), num_envs=EPISODES, seed=0, split="dev", num_threads=1, sensor=sensor)
    read: list[TensorDictBase] = []
    seeing.planner.register_forward_pre_hook(lambda _, inputs: read.append(inputs[0].copy()))
    seen = env.reset()
    seen[keys.PLAN] = TensorDict(seeing.empty_memory(seen[keys.TOOL_POS]), seen.batch_size)
    for _ in range(STEPS):
        seen = env.step_and_maybe_reset(seeing(seen))[1]
    return read[-1]


def forecasters(form: str) -> dict[str, DynamicPlanner]:
    """The planner with the forecaster trained without noise, and with the other, as loaded or for inference."""
    planner = load_task(TASK).planner("wait_and_drop")
    both: Any = planner.forecaster
    assert isinstance(both, ForecastByNoise)
    made = {name: planner.with_parts(forecaster=getattr(both, name)) for name in ("exact", "noisy")}
    return made if form == "loaded" else {name: one.for_inference() for name, one in made.items()}


def compare(form: str, batch: int, seen: TensorDictBase, arguments: Arguments) -> Row:
    """Durations of both kinds of re-plans of ``batch`` rows [µs], and their ratio."""
    rows: Any = seen[torch.arange(batch) % EPISODES]
    durations: dict[str, list[float]] = {}
    calls = {}
    for name, planner in forecasters(form).items():
        length: Any = planner.forecaster.history
        history = rows[keys.TARGET_HISTORY][:, -length:]
        observation = observe(planner, rows.copy().set(keys.TARGET_HISTORY, history))
        inputs = *Plan.hold(observation, 0), *observation.flat()
        calls[name], durations[name] = partial(flat_replan(planner), *inputs), []
    for _ in range(arguments.blocks):
        for name, call in calls.items():
            durations[name].append(1e6 * median(sample(call, seconds=arguments.seconds)))
    ratios = [noisy / exact for exact, noisy in zip(durations["exact"], durations["noisy"], strict=True)]
    return {f"{name}_us": round(median(values), 1) for name, values in durations.items()} | {"ratio": median(ratios)}


def main(arguments: Arguments) -> None:
    """Measure."""
    study = Study(arguments, scene=load_task(TASK).digest(), resume=False)
    with measuring():
        seen = tracked()
        for form in ("loaded", "for inference"):
            for batch in arguments.batches:
                study.add({"planner": form, "batch": batch} | compare(form, batch, seen, arguments))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
