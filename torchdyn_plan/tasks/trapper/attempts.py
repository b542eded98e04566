"""Recorded attempts to trap the ball: where the box waited, how the ball came by, and whether it was trapped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.trapper.env import TrapperEnv
from torchdyn_plan.envs.trapper.keys import POCKETED, TRAPPED
from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.nets.capture import CaptureConfig, CaptureNetwork
from torchdyn_plan.training.capture_data import LATEST, PASSED, Attempts, Captures, FarSighted, Guessing
from torchdyn_plan.training.collect import SERIES

FASTEST = 5.5
"""Balls start with velocities up to this [m/s], fast ones more often."""
LEAST = 0.5
"""Least factor by which an exploring planner multiplies the worth of a meeting."""
SWITCHING_COST = 18.0
"""Keeps an exploring planner at the meeting that it chose, though it draws anew at each plan."""
CONFIG = CaptureConfig(mirrored=True)
"""Sizes of the network of captures."""


def record_attempts(
    planner: Any,
    blocks: Sequence[Tensor],
    *,
    seed: int,
    num_threads: int = 0,
    scene: TrapperScene | str | None = None,
) -> dict[str, Tensor]:
    """Attempts of ``planner``, a *wait and drop*, that explores: it takes other meetings than the best.

    Args:
        planner: whose static planner, networks and maneuver are used.
        blocks: numbers of the episodes of the split ``train`` that run side by side, in one tensor each. Balls of a
            block start at the same speed; an environment goes on with another ball when an episode ends.
        seed: which series of episodes.
        num_threads: of the simulation, 0 for all cores.
        scene: that the planner belongs to, or its name; that with a real UR5's limits by default.

    Returns:
        The entries of `Captures`.
    """
    found = []
    for episodes in blocks:
        number = seed * SERIES + int(episodes[0])
        draw = torch.Generator().manual_seed(number)
        velocity = FASTEST * float(torch.rand((), generator=draw).sqrt())
        world: dict[str, Any] = {"velocity": velocity, "scene": scene, "num_threads": num_threads}
        env = TrapperEnv(len(episodes), seed=number, split="train", **world)
        found.append(record_block(explorer(planner, draw), env, draw, first=int(episodes[0])))
    return Captures(*map(torch.cat, zip(*found, strict=True)))._asdict()


def explorer(planner: Any, draw: torch.Generator) -> Any:
    """``planner``, made to explore by ``draw``."""
    return planner.with_parts(
        capture=Guessing(draw, least=LEAST),
        search=replace(planner.search, probability_weight=30.0, switching_cost=SWITCHING_COST),
        maneuver=FarSighted(maneuver=planner.maneuver, lookahead=LATEST + CONFIG.window + 1),
    )


@torch.no_grad()
def record_block(planner: Any, env: TrapperEnv, draw: torch.Generator, *, first: int) -> Captures:
    """Attempts in the environments of ``env``, the first of which counts as run ``first``."""
    network = CaptureNetwork(CONFIG)
    attempts, state = Attempts(CONFIG, env.num_envs, draw), env.reset()
    drops = torch.full((env.num_envs,), -1)
    for _ in range(env.max_steps):
        fresh = state.get(keys.STEP_COUNT).squeeze(-1) == 0
        attempts.drop(fresh)
        stepped, state = env.step_and_maybe_reset(planner(state))
        plan = dict(stepped.get(keys.PLAN).items())
        before, drops = drops.masked_fill(fresh, -1), plan["drop_step"]
        attempts.end((before >= 0) & (drops < 0), captured=False)
        coming = plan["arrival_steps"]
        in_range = (coming >= attempts.soonest) & (coming <= LATEST)
        new = (plan["age"] == 0) & plan["reachable"] & (drops < 0) & in_range
        window = network.windows(plan["path"], coming.unsqueeze(-1)).squeeze(-3)
        attempts.renew(new, window, plan["goal"])
        attempts.watch(stepped.get(keys.TOOL_POS), coming)
        trapped, pocketed, done = (stepped.get(("next", name)).squeeze(-1) for name in (TRAPPED, POCKETED, "done"))
        attempts.end(trapped, captured=True)
        attempts.end(done & pocketed, captured=False)
        attempts.end((attempts.past > PASSED) & (drops < 0), captured=False)
        attempts.drop(done)
    return attempts.found(first)
