"""What went wrong in an episode: one cause for each that failed, from what was recorded in it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.evaluation.episodes import EpisodeLog
from torchdyn_plan.evaluation.results import NO_CAUSE, EpisodeOutcomes
from torchdyn_plan.evaluation.traces import Trace
from torchdyn_plan.tasks.task import Truth, Verdict
from torchdyn_plan.tasks.trapper.evidence import Evidence, find_evidence
from torchdyn_plan.tasks.trapper.task import CAUSES

FORECAST_TOLERANCE = 0.04
"""A ball that comes no nearer than this to the promised place about the promised time is elsewhere [m]."""
JOINT_SPEED = "joint_speed"
"""Evidence: the greatest speed of any joint over its limit."""
TOO_FAST = 1.02
"""A joint is beyond its limit above this share of it: a little more is how a servo settles."""
ETA_TOLERANCE = 5
"""An arm that comes later than promised by more than this is late: a bin of the arrival predictor [control steps]."""


def judge_episodes(log: EpisodeLog, truth: Truth, scene: TrapperScene) -> Verdict:
    """Why the episodes of ``log`` failed, what their records say of it, and whether the ball was ``touched``."""
    evidence = Evidence.none(len(log.done))
    joint_speed = torch.zeros(len(log.done))
    for episodes, trace in log.records():
        joint_speed[episodes] = fastest(trace) / scene.joint_speed
        for whole, part in zip(evidence, find_evidence(scene, trace, truth.future[episodes]), strict=True):
            whole[episodes] = part
    touched = evidence.contact_step >= 0
    cause = failure_cause(log.success, truth.solvable, touched, log.flags["pocketed"], evidence)
    return Verdict(cause, {"touched": touched}, evidence._asdict() | {JOINT_SPEED: joint_speed})


def fastest(trace: Trace) -> Tensor:
    """Greatest speed of any joint in each episode, ``(R,)`` [rad/s].

    Commands keep to the limits, and so do joints that nothing pushes: what is above comes of the box's contact with
    ball, table or rails.
    """
    within = torch.arange(trace.joint_speed.shape[1]) <= trace.length.unsqueeze(-1)
    return trace.joint_speed.masked_fill(~within, 0.0).amax(-1)


def measure(outcomes: EpisodeOutcomes) -> dict[str, float | None]:
    """How far joints pass their speed limits: the peak of all episodes, and the share of successes that pass them.

    Both are None of outcomes that do not tell of it, and the share is None where there is no success.
    """
    speed = outcomes.evidence.get(JOINT_SPEED)
    if speed is None:
        return dict.fromkeys(("joint_speed_peak", "joint_speed_above"))
    above = (speed > TOO_FAST)[outcomes.success]
    share = above.double().mean().item() if len(above) else None
    return {"joint_speed_peak": speed.max().item(), "joint_speed_above": share}


def failure_cause(trapped: Tensor, solvable: Tensor, touched: Tensor, pocketed: Tensor, evidence: Evidence) -> Tensor:
    """Index into the task's ``causes`` of the first cause that holds, or `NO_CAUSE` for a success; int64 ``(*B,)``.

    - unreachable: not solvable, so nothing that the planner does can help.
    - planner_too_slow: it made plans, but none promised a meeting that the arm could be in time for.
    - forecast: the ball did not come to the promised place about the promised time (`FORECAST_TOLERANCE`).
    - eta: the arm came to its goal later than promised, by more than `ETA_TOLERANCE`, or never.
    - early_contact: the ball ran into a box that was down already, or rested where the box came down.
    - pocketed: no meeting was promised, nothing was touched, and the ball fell into a pocket.
    - late: all else. The box came down behind the ball or not at all, or time ran out.

    Args:
        trapped: ``(*B,)`` bool, the ball is covered and kept, whatever else happened.
        solvable: ``(*B,)`` bool, the static planner could have been at some future place of the ball in time
            (paper, Section IV-B).
        touched: ``(*B,)`` bool, the ball met the outside of the box.
        pocketed: ``(*B,)`` bool, the ball fell into a pocket.
        evidence: ``(*B,)`` each.
    """
    holds = {
        "unreachable": ~solvable,
        "planner_too_slow": evidence.planned & ~evidence.promised,
        "forecast": evidence.promised & (evidence.forecast_error > FORECAST_TOLERANCE),
        "eta": evidence.promised & (evidence.eta_error > ETA_TOLERANCE),
        "early_contact": touched & ~evidence.receding,
        "pocketed": pocketed & ~touched & ~evidence.promised,
        "late": torch.ones_like(trapped),
    }
    in_order = torch.stack([holds[cause] for cause in CAUSES], dim=-1)
    return torch.where(trapped, NO_CAUSE, in_order.to(torch.int64).argmax(dim=-1))
