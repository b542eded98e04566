"""One side of `former_latency.py`: runs timings in the checkout it is started in, on request over a pipe.

Requests and answers are lines of JSON. It supports the planners' current interface, and that of the last checkout
before tasks became folders (65afd9a), whose wait-and-drop planner was called `MeetingPlanner`.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from safetensors.torch import load_file
from tensordict import TensorDict
from torch import Tensor

import torchdyn_plan

CALLS = {
    "plan": "a plan, eager",
    "plan_for_inference": "a plan, eager, networks for inference",
    "plan_compiled": "a plan, compiled, networks for inference",
    "step_that_plans": "a planner's step that plans",
    "step_between_plans": "a planner's step between plans",
    "static_step": "its static planner's step alone",
}
"""What is timed, in words."""


NOISY = "wait_and_drop_noisy"
"""*Wait and drop* with the networks trained with noise; where there are none yet, with those that there are."""


def make_planner(name: str, static: str) -> Any:
    """Trapper's planner ``name``, as this checkout makes it."""
    try:
        from torchdyn_plan.tasks import load_task
    except ImportError:
        import torchdyn_plan.planners

        planners: Any = torchdyn_plan.planners

        kind = planners.MeetingPlanner if name in ("wait_and_drop", NOISY) else planners.DynamicPlanner
        return kind.from_pretrained(f"trapper-{static}").eval()
    if name != NOISY:
        return load_task("trapper").planner(name, static)
    planner = load_task("trapper").planner("wait_and_drop", static)
    both: Any = planner.forecaster
    return planner.with_parts(forecaster=both.noisy)


def tracked(step: TensorDict, planner: Any) -> TensorDict:
    """What ``planner`` reads of ``step``: as long a history, and if it needs one, a track's covariance."""
    forecaster: Any = getattr(planner, "forecaster", None)
    if "target_covariance" not in getattr(forecaster, "in_keys", ()):
        return step
    history = step["target_history"]
    missing = forecaster.history - history.shape[-2]
    whole = torch.cat([history[:, :1].expand(-1, missing, -1), history], dim=1)
    covariance = torch.tensor([[1e-6, 1e-6], [1e-6, 1e-3]]).expand(len(history), 2, 2)
    return step.copy().update({"target_history": whole, "target_covariance": covariance})


def for_inference(planner: Any) -> Any:
    """The planner with networks for inference."""
    return planner.for_inference() if hasattr(planner, "for_inference") else planner.folded()


def plan_call(planner: Any, seen: TensorDict) -> tuple[Callable[..., Sequence[Tensor]], tuple[Any, ...]]:
    """What makes a plan, and its arguments: what the planner itself does for rows that plan."""
    if not hasattr(planner, "replan"):
        planned_steps = torch.zeros(seen.batch_size, dtype=torch.int64)
        entries = seen["robot_state"], seen["target_pos"], seen["tool_pos"], planned_steps
        return planner.plan_ahead, (*entries, seen["target_history"])
    from torchdyn_plan.bench.observations import observe
    from torchdyn_plan.planners import Plan

    observation = observe(planner, seen)
    return planner.replan, (observation, Plan.hold(observation, 0))


class Side:
    """The calls of one planner, ready to be timed."""

    def __init__(self, steps: Sequence[TensorDict]) -> None:
        """Time on these ``steps``: what was seen from an episode's beginning to its first plan and one step further."""
        self.steps = steps
        self.calls: dict[str, Callable[[], Any]] = {}

    def prepare(self, planner: str, static: str, compiled: bool) -> dict[str, Any]:
        """Make the calls of a planner; returns their names and what the last plan and steps gave."""
        made = make_planner(planner, static)
        before, after = self._play(made, [tracked(step, made) for step in self.steps])
        at_rest = after.copy().set("goal", made(before.copy())["goal"])
        light = for_inference(made)
        plan, inputs = plan_call(made, before)
        light_plan, light_inputs = plan_call(light, before)
        self.calls = {
            "plan": lambda: plan(*inputs),
            "plan_for_inference": lambda: light_plan(*light_inputs),
            "step_that_plans": lambda: made(before.copy()),
            "step_between_plans": lambda: made(after.copy()),
            "static_step": lambda: made.static(at_rest.copy()),
        }
        if compiled:
            fast: Any = torch.compile(light_plan, fullgraph=True, dynamic=False, options={"cpp_wrapper": True})
            self.calls["plan_compiled"] = lambda: fast(*light_inputs)
        plans = [call()[:2] for name, call in self.calls.items() if name.startswith("plan")]
        acted = [self.calls[name]()["action"] for name in ("step_that_plans", "step_between_plans")]
        return {
            "calls": list(self.calls),
            "plans": [[goal.flatten().tolist(), steps.flatten().tolist()] for goal, steps in plans],
            "actions": [action.flatten().tolist() for action in acted],
        }

    def time(self, call: str, seconds: float) -> list[float]:
        """Durations of a call [µs], over and over for ``seconds``."""
        function, durations = self.calls[call], []
        function()
        deadline = time.perf_counter() + seconds
        while time.perf_counter() < deadline:
            started = time.perf_counter()
            function()
            durations.append(1e6 * (time.perf_counter() - started))
        return durations

    def _play(self, planner: Any, steps: Sequence[TensorDict]) -> tuple[TensorDict, TensorDict]:
        """What of ``steps`` is seen, with the planner's memory, at its first plan and at the step after it."""
        memory = None
        for step, after in itertools.pairwise(steps):
            before = _with_memory(step, memory)
            memory = planner(before.copy())["plan"]
            if memory["replanned"].all():
                return before, _with_memory(after, memory)
        raise RuntimeError("the planner did not plan on the steps that were recorded")


def _with_memory(seen: TensorDict, memory: Any) -> TensorDict:
    return seen.copy() if memory is None else seen.copy().set("plan", memory)


def serve(observations: str) -> None:
    """Answer line by line; ``observations`` is a safetensors file of entries ``(T, 1, …)``."""
    answers = os.fdopen(os.dup(1), "w")
    # Nothing else may come between the answers.
    os.dup2(2, 1)
    entries = load_file(observations)
    side = Side(
        [TensorDict({key: value[step] for key, value in entries.items()}, [1]) for step in range(_length(entries))]
    )
    answer = partial(print, file=answers, flush=True)
    answer(json.dumps(torchdyn_plan.__file__))
    torch.set_num_threads(1)
    with torch.no_grad():
        for line in sys.stdin:
            name, arguments = json.loads(line)
            answer(json.dumps(getattr(side, name)(*arguments)))


def _length(entries: dict[str, Tensor]) -> int:
    return len(next(iter(entries.values())))


if __name__ == "__main__":
    serve(sys.argv[1])
