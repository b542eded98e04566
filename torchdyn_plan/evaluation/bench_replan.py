"""Latency of a re-plan, of its parts, and of a whole planner step around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.run import one_thread
from torchdyn_plan.evaluation.timing import figures, sample
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.nets.eta import Arrival
from torchdyn_plan.planners import DynamicPlanner, ExactSearch, IKPlanner

BATCHES = (1, 64, 1024, 10000)
"""Rows that plan at once."""
SINGLES = 16
"""Rows of a batch that are compared with the same rows computed one by one."""
FIRST_PLAN = 13
"""Control step of the first plan."""

Part = Callable[[TensorDictBase], tuple[Tensor, ...]]
"""Something timed: from what the planner sees of some rows to what is compared."""


def bench(
    planner: DynamicPlanner | None = None, *, batches: Sequence[int] = BATCHES, seconds: float = 0.4
) -> list[dict[str, Any]]:
    """A row for each device, batch and part: latency, and the greatest difference from the rows one by one.

    Args:
        planner: an `IKPlanner` made to meet a moving target by networks; the one that ships by default.
        batches: rows that plan at once.
        seconds: time spent on each figure.
    """
    from tqdm import tqdm

    planner = planner or DynamicPlanner.from_pretrained("trapper-ik")
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    rows = []
    with one_thread(), torch.no_grad():
        for device in devices:
            parts = _parts(planner.to(device))
            for batch in tqdm(batches, desc=f"replan on {device}", unit="batch", leave=False):
                seen = observations(batch).to(device)
                seen.set(keys.PLAN, planner(seen.copy())[keys.PLAN])
                rows += [_row(what, part, seen, device, seconds) for what, part in parts.items()]
    planner.to("cpu")
    return rows


def _row(what: str, part: Part, seen: TensorDictBase, device: str, seconds: float) -> dict[str, Any]:
    batch = len(seen)
    durations = sample(partial(part, seen), device=device, seconds=seconds)
    about = {
        "what": what, "implementation": "torchdyn_plan", "batch": batch, "threads": torch.get_num_threads(),
        "compiled": False, "device": device,
    }  # fmt: skip
    return about | figures(durations, batch) | {"max_error": _error(part, seen)}


def _error(part: Part, seen: TensorDictBase) -> float:
    """Greatest difference between the first rows of a batch and the same rows one by one."""
    singles = [part(seen[row : row + 1]) for row in range(min(SINGLES, len(seen)))]
    pairs = zip(part(seen), map(torch.cat, zip(*singles, strict=True)), strict=True)
    return max(float((whole[: len(single)].double() - single.double()).abs().max()) for whole, single in pairs)


def observations(batch: int) -> TensorDict:
    """What a planner sees of ``batch`` arms near home and balls that roll straight at 1 to 5 m/s, at the first plan."""
    scene, random = TrapperScene(), torch.Generator().manual_seed(0)
    static = IKPlanner()
    joint_pos = torch.tensor(scene.home) + 0.2 * torch.randn(batch, 6, generator=random)
    joint_vel = 0.5 * torch.randn(batch, 6, generator=random)
    tool_pos = static.arm(joint_pos)[:, :3, 3] + torch.tensor(scene.base_pos)
    speed = 1.0 + 4.0 * torch.rand(batch, 1, generator=random)
    angle = 2 * torch.pi * torch.rand(batch, 1, generator=random)
    velocity = speed * torch.cat([angle.cos(), angle.sin(), torch.zeros(batch, 1)], dim=-1)
    target = 0.5 * scene.half_side * (2.0 * torch.rand(batch, 1, 3, generator=random) - 1.0)
    target[..., 2] = scene.ball_radius
    past = scene.control_step * torch.arange(-23.0, 1.0).clamp_min(-FIRST_PLAN).unsqueeze(-1)
    history = target + velocity.unsqueeze(1) * past
    entries = {
        keys.JOINT_POS: joint_pos, keys.JOINT_VEL: joint_vel, keys.TOOL_POS: tool_pos,
        keys.ROBOT_STATE: torch.cat([joint_pos, joint_vel, tool_pos], dim=-1),
        keys.TARGET_POS: history[:, -1], keys.TARGET_HISTORY: history, keys.GOAL: history[:, -1],
        keys.STEP_COUNT: torch.full((batch,), FIRST_PLAN),
    }  # fmt: skip
    return TensorDict(entries, batch_size=[batch])


def _parts(planner: DynamicPlanner) -> dict[str, Part]:
    """What is timed, by name."""
    static, forecaster, eta = planner.static, planner.forecaster, planner.eta
    assert isinstance(static, IKPlanner)
    assert isinstance(forecaster, Forecaster)
    assert isinstance(eta, ETANetwork)

    def replan(seen: TensorDictBase) -> tuple[Tensor, ...]:
        return planner.plan(seen[keys.ROBOT_STATE], seen[keys.TARGET_POS], seen[keys.TARGET_HISTORY])[:2]

    def replan_exactly(seen: TensorDictBase) -> tuple[Tensor, ...]:
        arrival = partial(eta.arrival, seen[keys.ROBOT_STATE].unsqueeze(-2))
        return ExactSearch()(forecaster(seen[keys.TARGET_HISTORY]), seen[keys.TARGET_POS], arrival)[:2]

    def arrivals(seen: TensorDictBase, goals: int) -> tuple[Tensor, ...]:
        state, goal = seen[keys.ROBOT_STATE].unsqueeze(1), seen[keys.TARGET_POS].unsqueeze(1)
        return (eta(state, goal.expand(-1, goals, 3)),)

    def search(seen: TensorDictBase) -> tuple[Tensor, ...]:
        here = seen[keys.TARGET_POS]
        newest = seen[keys.TARGET_HISTORY].diff(dim=1)[:, -1:]
        forecast = here.unsqueeze(1) + newest * forecaster.steps_ahead.unsqueeze(-1)
        return planner.search(forecast, here, _constant_arrival)[:2]

    return {
        "re-plan": replan,
        "re-plan, exact search": replan_exactly,
        "forecaster": lambda seen: (forecaster(seen[keys.TARGET_HISTORY]),),
        "ETA, 1 goal": partial(arrivals, goals=1),
        "ETA, 4 goals": partial(arrivals, goals=4),
        "search alone": search,
        "IK path of 5 steps": lambda seen: (static.path(seen[keys.JOINT_POS], seen[keys.GOAL]),),
        "planner step that plans": lambda seen: (planner(seen.exclude(keys.PLAN))[keys.ACTION],),
        "planner step between plans": lambda seen: (planner(seen.copy())[keys.ACTION],),
    }


def _constant_arrival(goal: Tensor, **_: Any) -> Arrival:
    """Every goal in 50 control steps, at no cost."""
    return Arrival(goal.new_full(goal.shape[:-1], 50.0), goal.new_zeros(goal.shape[:-1], dtype=torch.bool))
