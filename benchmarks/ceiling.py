"""Ceiling of success: each solvable episode is tried with many meeting and drop times, with the true future known.

A schedule waits above the ball's true position at step t and drops the box some steps earlier, either there or
following the ball. It starts at step 13, like the planners, and is simulated. The ceiling is the share of solvable
episodes that at least one schedule traps.

python benchmarks/ceiling.py --out benchmarks/results/ceiling.json
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
import tyro
from study import Episodes, Row, Setting, Study, each, measuring, rate_entries
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from torchdyn_plan import keys
from torchdyn_plan.envs import TrapperScene, TrapperSimulation
from torchdyn_plan.envs.trapper.contact import is_covered
from torchdyn_plan.envs.trapper.env import HOLD_STEPS
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.planners import ReplanSchedule
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.solvable import arrival_map
from torchdyn_plan.tasks.trapper.task import ik_planner
from torchdyn_plan.tasks.trapper.wait_and_drop import WaitAndDrop, pulled, waiting_search

SCENE = TrapperScene()
MANEUVER = WaitAndDrop.of(SCENE)
SEARCH = waiting_search(SCENE)
START = ReplanSchedule().first_step
"""Control step at which a schedule starts, and until which the arm stays at home."""
SOONEST = 12
"""A schedule is tried where the arm would be down at the place this many steps late, at worst."""
AFTERWARDS = 40
"""Control steps that are simulated after the last meeting."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Measure the ceiling; the solvable ones of the episodes are tried."""

    velocities: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """[m/s]"""
    episodes: int = 200
    split: str = "test"
    spacing: int = 3
    """Control steps between meeting times."""
    meetings: int = 32
    """Meeting times of an episode that are tried at most, evenly among those in reach."""
    leads: tuple[int, ...] = (5, 8, 11, 14, 17)
    """Control steps before the meeting at which the box is let down."""
    follow: int = MANEUVER.aim_ahead_steps
    """A box that follows is sent to where the ball is so many steps later."""
    rows: int = 4096
    """Schedules simulated side by side."""


def row_of(arguments: Arguments, setting: Setting, velocity: float) -> Row:
    """Share of solvable episodes that a schedule traps, and how many of the schedules tried for one do."""
    future, solvable = setting.truth
    future, episodes = future[solvable], solvable.nonzero().squeeze(-1)
    place, speed = draw_starts(SCENE, episodes, velocity=velocity, split=arguments.split, seed=arguments.seed)
    static = setting.task.static_planner(setting.static, chunk=setting.task.rows_at_once[1])
    arrivals = arrival_map(setting.static, static, SCENE)
    last = setting.task.max_steps
    episode, meeting = _meetings(arguments, arrivals.at(future[:, : last + 1]), future, last)
    grid = torch.cartesian_prod(torch.arange(len(episode)), torch.tensor(arguments.leads), torch.tensor([0, 1]))
    pair, lead, follows = grid.unbind(-1)
    episode, meeting = episode[pair], meeting[pair]
    order = meeting.argsort(stable=True)
    trapped = torch.zeros(len(order), dtype=torch.bool)
    for rows in tqdm(order.split(arguments.rows), desc=f"{velocity:g} m/s", leave=False, disable=None):
        which = episode[rows]
        schedules = Schedules(meeting[rows], meeting[rows] - lead[rows], follows[rows].bool())
        balls = place[which], speed[which], future[which]
        trapped[rows] = simulate(balls, schedules, ahead=arguments.follow, threads=arguments.threads)
    hits = torch.zeros(len(future)).index_add_(0, episode, trapped.float())
    tried = torch.zeros(len(future)).index_add_(0, episode, torch.ones(len(episode)))
    still = torch.zeros(len(future)).index_add_(0, episode, (trapped & (follows == 0)).float())
    return {
        "solvable": len(future),
        **rate_entries("ceiling", int((hits > 0).sum()), len(future)),
        "without following": float((still > 0).float().mean()),
        "schedules": len(order),
        "share of schedules that trap": float((hits / tried.clamp_min(1)).mean()),
    }


class Schedules(NamedTuple):
    """What is done in each row, ``(R,)`` each."""

    meeting: Tensor
    """Step whose place of the ball is waited above."""
    drop: Tensor
    """Step at which the box is let down."""
    follows: Tensor
    """Whether it then follows the ball."""


def simulate(balls: tuple[Tensor, Tensor, Tensor], schedules: Schedules, *, ahead: int, threads: int) -> Tensor:
    """Whether each schedule traps its ball, ``(R,)``.

    Args:
        balls: start ``(R, 2)``, velocity ``(R, 2)`` and true path ``(R, T, 3)`` of each row's.
        schedules: one a row.
        ahead: a box that follows is sent to where the ball is so many steps later.
        threads: of the simulation.
    """
    place, speed, future = balls
    count, rows = len(place), torch.arange(len(place))
    simulation = TrapperSimulation(count, SCENE, num_threads=threads)
    simulation.reset(rows, place, speed)
    arm, base, planner = Arm.ur5(tool_length=SCENE.tool_length), torch.tensor(SCENE.base_pos), ik_planner(SCENE)
    above = SEARCH.goals(future[rows, schedules.meeting])
    held, trapped = torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.bool)
    memory: TensorDict | None = None
    for step in range(int(schedules.meeting.max()) + AFTERWARDS):
        joint_pos = simulation.joint_pos.float()
        pose = arm(joint_pos)
        tool = pose[:, :3, 3] + base
        held = torch.where(is_covered(SCENE, tool, pose[:, :3, :3], simulation.ball_pos.float()), held + 1, 0)
        trapped |= held >= HOLD_STEPS
        if step < START:
            simulation.step(torch.zeros(count, 6))
            continue
        ball = future[:, min(step + ahead, future.shape[1] - 1)]
        goal = _goal(schedules, step, tool, ball, above)
        entries = {keys.JOINT_POS: joint_pos, keys.GOAL: goal, keys.STEP_COUNT: torch.full((count,), step)}
        if memory is not None:
            entries[keys.PLAN] = memory
        planned = planner(TensorDict(entries, [count]))
        memory = planned[keys.PLAN]
        simulation.step(planned[keys.ACTION])
    return trapped


def _goal(schedules: Schedules, step: int, tool: Tensor, ball: Tensor, above: Tensor) -> Tensor:
    """Goals ``(R, 3)`` at ``step``: above the meeting place, from the drop on down, there or after the ball."""
    level = pulled(tool[:, :2], ball[:, :2], MANEUVER.pull).clamp(-MANEUVER.half_extent, MANEUVER.half_extent)
    following = schedules.follows & (step >= schedules.drop + MANEUVER.follow_after)
    level = torch.where(following.unsqueeze(-1), level, above[:, :2])
    down = torch.nn.functional.pad(level, (0, 1), value=MANEUVER.drop_height)
    return torch.where((step >= schedules.drop).unsqueeze(-1), down, above)


def _meetings(arguments: Arguments, needed: Tensor, future: Tensor, last: int) -> tuple[Tensor, Tensor]:
    """Episode and step of each meeting tried: spread over those that the arm can be in time for."""
    steps = torch.arange(START + max(arguments.leads), last, arguments.spacing)
    ready = (needed[:, steps] + START - SOONEST <= steps) & (future[:, steps, 2] > 0.0)
    number = ready.cumsum(-1)
    stride = (number[:, -1:] / arguments.meetings).ceil().clamp_min(1).long()
    episode, index = (ready & ((number - 1) % stride == 0)).nonzero(as_tuple=True)
    return episode, steps[index]


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper")
    study = Study(arguments, scene=task.digest())
    names = ("spacing", "meetings", "leads", "follow")
    tried = {name: getattr(arguments, name) for name in names} | {"leads": list(arguments.leads)}
    with measuring():
        for velocity in each(arguments.velocities, "ceiling"):
            setting = Setting(task, arguments, velocity=velocity)
            study.row({**setting.about, **tried}, partial(row_of, arguments, setting, velocity))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
