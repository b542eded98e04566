"""Worst-case latency of a planner: very many re-plans, one at a time, on one thread.

python benchmarks/worst_case.py --out benchmarks/results/worst_case.json

A call is a whole planner step of one row in which a plan is due. A call that takes longer than a control step in wall
time, but not in processor time, was interrupted by the machine. How often this happens is measured separately: an empty
loop spins between the blocks of calls, and its gaps are counted.
"""

from __future__ import annotations

import gc
import resource
import time
from dataclasses import dataclass
from typing import Any

import torch
import tyro
from study import Output, Row, Study, each, measuring
from tensordict import TensorDict

from torchdyn_plan import keys
from torchdyn_plan.planners import Background
from torchdyn_plan.tasks import Task, load_task
from torchdyn_plan.threads import one_thread

STEP = 0.004
"""Control step of the task [s]."""
EPISODES, ENVS = 128, 64
"""Episodes whose re-plans are the calls, over and over, and how many run side by side."""
BLOCK = 500
"""Calls between two looks at what the machine takes."""
SPIN = 0.1
"""Share of the calls' time for which the idle loop spins."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Time re-plans, and a planner in a thread beside a loop in real time."""

    planners: tuple[str, ...] = ("wait", "corner", "exact", "wait_and_drop")
    """Planners for the moving target."""
    statics: tuple[str, ...] = ("ik", "rl")
    """Static planners below each of them."""
    calls: int = 1_000_000
    """Re-plans, of all planners together."""
    seconds: float = 120.0
    """How long the loop with a planner in a thread runs [s]."""


def plannings(task: Task, planner: Any) -> list[TensorDict]:
    """What ``planner`` sees at each of its re-plans in `EPISODES` episodes, a row each."""
    env = task.make_env(task.default_settings(), num_envs=ENVS, seed=0, split="dev", num_threads=1)
    seen = env.reset()
    found, ended = [], 0
    while ended < EPISODES:
        before = seen.copy()
        acted = planner(seen)
        # In the second step of a row its memory is there: the first one's is made, and takes longer.
        rows = acted[keys.PLAN, "replanned"].nonzero().squeeze(-1)
        if keys.PLAN in before.keys():  # noqa: SIM118
            found += [before[row : row + 1].clone() for row in rows.tolist()]
        stepped, seen = env.step_and_maybe_reset(acted)
        ended += int(stepped["next", "done"].sum())
    return found


def time_calls(planner: Any, moments: list[TensorDict], calls: int) -> Row:
    """Wall time of so many re-plans, and the machine's own gaps."""
    wall, running, switched, collected = torch.empty(4, calls, dtype=torch.float64)
    order = torch.randint(len(moments), (calls,), generator=torch.Generator().manual_seed(0)).tolist()
    gaps, spun = [], 0.0
    collector = Collector()
    # What is here for the measurement alone is none of the planner's garbage.
    gc.collect()
    gc.freeze()
    for _ in range(20):
        assert planner(moments[0].copy())[keys.PLAN, "replanned"].all()
    for call, index in enumerate(order):
        seen = moments[index].copy()
        collector.seconds = 0.0
        switches, ran, started = _switches(), time.thread_time(), time.perf_counter()
        planner(seen)
        wall[call] = time.perf_counter() - started
        running[call], switched[call] = time.thread_time() - ran, _switches() - switches
        collected[call] = collector.seconds
        if call % BLOCK == BLOCK - 1:
            length = SPIN * float(wall[call - BLOCK + 1 : call + 1].sum())
            gaps += spin(length)
            spun += length
    collector.close()
    gc.unfreeze()
    return told(wall, running, switched, collected) | {
        "moments": len(moments),
        "idle_seconds": spun,
        "idle_gaps": len(gaps),
        "idle_longest_gap_us": 1e6 * max(gaps, default=0.0),
    }


def spin(seconds: float) -> list[float]:
    """Gaps longer than half a control step in a loop that only looks at the clock [s]: taken by the machine."""
    gaps, last = [], time.perf_counter()
    end = last + seconds
    while last < end:
        now = time.perf_counter()
        if now - last > STEP / 2:
            gaps.append(now - last)
        last = now
    return gaps


class Collector:
    """Python's garbage collector, and how long it has worked."""

    def __init__(self) -> None:
        """Watch it."""
        self.seconds, self._started = 0.0, 0.0
        gc.callbacks.append(self._note)

    def close(self) -> None:
        """Watch it no more."""
        gc.callbacks.remove(self._note)

    def _note(self, phase: str, _: dict[str, int]) -> None:
        now = time.perf_counter()
        if phase == "start":
            self._started = now
        else:
            self.seconds += now - self._started


def told(wall: torch.Tensor, running: torch.Tensor, switched: torch.Tensor, collected: torch.Tensor) -> Row:
    """Figures of calls, by the clock on the wall unless they say otherwise.

    Beside: their ``running`` time, how often they were ``switched`` off, how long Python ``collected`` garbage.
    """
    points = torch.quantile(wall[: 2**24], torch.tensor([0.5, 0.99, 0.999], dtype=wall.dtype)).mul(1e6).tolist()
    late = wall > STEP
    interrupted = late & (running <= STEP)
    return {
        "calls": len(wall),
        **dict(zip(("p50_us", "p99_us", "p99.9_us"), points, strict=True)),
        "max_us": 1e6 * wall.max().item(),
        "max_running_us": 1e6 * running.max().item(),
        "above_step": int(late.sum()),
        "above_step_interrupted": int(interrupted.sum()),
        "above_step_switched": int((late & (switched > 0)).sum()),
        "above_step_unexplained": int((late & ~interrupted & (switched == 0)).sum()),
        "collected_max_us": 1e6 * collected.max().item(),
        "late_us": (1e6 * wall[late]).sort(descending=True).values[:20].round().tolist(),
        "late_running_us": _of_longest(1e6 * running, wall, late),
        "late_collected_us": _of_longest(1e6 * collected, wall, late),
        "seconds": wall.sum().item(),
    }


def _of_longest(values: torch.Tensor, wall: torch.Tensor, late: torch.Tensor) -> list[float]:
    """``values`` of the longest calls that were ``late``."""
    return values[late][wall[late].argsort(descending=True)][:20].round().tolist()


class Watched(Background):
    """Notes how old plans are when they come into use [control steps]."""

    def __init__(self, **settings: Any) -> None:
        """As `Background`."""
        super().__init__(**settings)
        self.ages: list[int] = []

    def arrive(self, plan: Any, state: Any, observation: Any) -> Any:
        """As `Background.arrive`."""
        order, used = self._order, self.used
        found = super().arrive(plan, state, observation)
        if order is not None and self.used > used:
            self.ages.append(int((observation.step_count - order.step_count).max()))
        return found


def real_time(task: Task, name: str, static: str, *, latency: int, deadline: int, seconds: float) -> Row:
    """A loop that takes a step every `STEP` seconds, or as soon as it can, with the planner in a thread."""
    delivery = Watched(latency=latency, deadline=deadline)
    planner = task.planner(name, static).with_parts(delivery=delivery).requires_grad_(False)
    env = task.make_env(task.default_settings(), num_envs=1, seed=0, split="dev", num_threads=1)
    seen, end = env.reset(), time.perf_counter() + seconds
    taken, late, due = [], 0, time.perf_counter()
    while due < end:
        started = time.perf_counter()
        acted = planner(seen)
        taken.append(time.perf_counter() - started)
        seen = env.step_and_maybe_reset(acted)[1]
        due += STEP
        now = time.perf_counter()
        late += now > due
        if now < due:
            time.sleep(due - now)
        else:
            due = now
    delivery.close()
    wall = torch.tensor(taken, dtype=torch.float64)
    points = torch.quantile(wall, torch.tensor([0.5, 0.99, 0.999], dtype=wall.dtype)).mul(1e6).tolist()
    return {
        "steps": len(taken),
        **dict(zip(("p50_us", "p99_us", "p99.9_us"), points, strict=True)),
        "max_us": 1e6 * wall.max().item(),
        "late_steps": late,
        "used": delivery.used,
        "missed": delivery.missed,
        "oldest_used": max(delivery.ages, default=0),
        "past_deadline": sum(age > deadline for age in delivery.ages),
    }


def _switches() -> int:
    """How often this thread was stopped for another one."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    pairs = [(name, static) for name in arguments.planners for static in arguments.statics]
    calls = -(-arguments.calls // len(pairs))
    with measuring():
        for name, static in each(pairs, "worst case"):
            about = {"what": "re-plan", "planner": name, "static": static, "calls": calls}

            def measure(name: str = name, static: str = static) -> Row:
                planner = task.planner(name, static).requires_grad_(False)
                return time_calls(planner, plannings(task, planner), calls)

            study.row(about, measure)
    for latency, deadline in ((1, 1), (1, 3), (2, 6)):
        about = {"what": "in a thread", "planner": "wait_and_drop", "static": "ik"}
        about |= {"latency": latency, "deadline": deadline, "asked_seconds": arguments.seconds / 3}
        with one_thread(), torch.no_grad():
            study.row(
                about,
                lambda latency=latency, deadline=deadline: real_time(
                    task, "wait_and_drop", "ik", latency=latency, deadline=deadline, seconds=arguments.seconds / 3
                ),
            )


if __name__ == "__main__":
    main(tyro.cli(Arguments))
