"""Ceiling of success: each solvable episode is tried with many meeting and drop times, with the true future known.

A schedule waits above the ball's true position at step t and drops the box some steps earlier, either there or
following the ball. It starts at the step of the planner's first plan, and is simulated. The ceiling is the share of
solvable episodes that at least one schedule traps.

    python benchmarks/ceiling.py --out benchmarks/results/ceiling.json
    python benchmarks/ceiling.py --scene paper --out runs/ceiling-paper.json
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
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
from torchdyn_plan.envs.trapper.scene import trapper_scene
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.solvable import arrival_map
from torchdyn_plan.tasks.trapper.task import ik_planner
from torchdyn_plan.tasks.trapper.wait_and_drop import WaitAndDrop, pulled, waiting_search

SOONEST = 12
"""A schedule is tried where the arm would be down at the place this many steps late, at worst."""
AFTERWARDS = 40
"""Control steps that are simulated after the last meeting."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Measure the ceiling; the solvable ones of the episodes are tried."""

    velocities: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """[m/s]"""
    scene: str = "ur5"
    """Scene of the task: ur5 or paper."""
    episodes: int = 1000
    split: str = "test"
    start: int = 3
    """Control step at which a schedule starts, and until which the arm stays at home: that of the first plan."""
    spacing: int = 1
    """Control steps between meeting times."""
    meetings: int = 80
    """Meeting times of an episode that are tried at most, evenly among those in reach."""
    leads: tuple[int, ...] = (5, 8, 11, 14, 17, 20)
    """Control steps before the meeting at which the box is let down."""
    follow: int = 7
    """A box that follows is sent to where the ball is so many steps later."""
    first: int = 8
    """Schedules of each episode in the first round; only episodes that none has trapped get another, twice as long."""
    rows: int = 4096
    """Schedules simulated side by side."""


def row_of(arguments: Arguments, setting: Setting, velocity: float) -> Row:
    """Share of solvable episodes that a schedule traps."""
    future, solvable = setting.truth
    future, episodes = future[solvable], solvable.nonzero().squeeze(-1)
    scene = trapper_scene(arguments.scene)
    place, speed = draw_starts(scene, episodes, velocity=velocity, split=arguments.split, seed=arguments.seed)
    static = setting.task.static_planner(setting.static, chunk=setting.task.rows_at_once[1])
    arrivals = arrival_map(setting.static, static, scene)
    last = setting.task.max_steps
    episode, meeting = _meetings(arguments, arrivals.at(future[:, : last + 1]), future, last)
    grid = torch.cartesian_prod(torch.arange(len(episode)), torch.tensor(arguments.leads), torch.tensor([0, 1]))
    pair, lead, follows = grid.unbind(-1)
    episode, meeting = episode[pair], meeting[pair]
    turn = _turns(episode, arguments.seed)
    trapped, tried = torch.zeros(len(future), dtype=torch.bool), 0
    for begin, end in pairwise(_rounds(arguments.first, len(turn))):
        now = ((turn >= begin) & (turn < end) & ~trapped[episode]).nonzero().squeeze(-1)
        if not len(now):
            break
        now = now[meeting[now].argsort(stable=True)]
        tried += len(now)
        for rows in tqdm(now.split(arguments.rows), desc=f"{velocity:g} m/s", leave=False, disable=None):
            which = episode[rows]
            schedules = Schedules(meeting[rows], meeting[rows] - lead[rows], follows[rows].bool())
            caught = simulate(scene, (place[which], speed[which], future[which]), schedules, arguments)
            trapped[which[caught]] = True
    return {
        "solvable": len(future),
        **rate_entries("ceiling", int(trapped.sum()), len(future)),
        "schedules": len(episode),
        "tried": tried,
        "lost": episodes[~trapped].tolist(),
    }


def _turns(episode: Tensor, seed: int) -> Tensor:
    """Place of each schedule in the random order in which those of its episode are tried, ``(S,)``."""
    shuffled = torch.randperm(len(episode), generator=torch.Generator().manual_seed(seed))
    order = shuffled[episode[shuffled].argsort(stable=True)]
    count = episode.bincount()
    first = (count.cumsum(0) - count)[episode[order]]
    return torch.empty_like(episode).index_copy_(0, order, torch.arange(len(episode)) - first)


def _rounds(first: int, count: int) -> list[int]:
    """Bounds of rounds that double: 0, ``first``, 3 times ``first``, ... until ``count``."""
    bounds = [0]
    while bounds[-1] < count:
        bounds.append(bounds[-1] * 2 + first)
    return bounds


class Schedules(NamedTuple):
    """What is done in each row, ``(R,)`` each."""

    meeting: Tensor
    """Step whose place of the ball is waited above."""
    drop: Tensor
    """Step at which the box is let down."""
    follows: Tensor
    """Whether it then follows the ball."""


def simulate(
    scene: TrapperScene, balls: tuple[Tensor, Tensor, Tensor], schedules: Schedules, arguments: Arguments
) -> Tensor:
    """Whether each schedule traps its ball, ``(R,)``.

    Args:
        scene: of the simulation.
        balls: start ``(R, 2)``, velocity ``(R, 2)`` and true path ``(R, T, 3)`` of each row's.
        schedules: one a row.
        arguments: of the study.
    """
    place, speed, future = balls
    maneuver = WaitAndDrop.of(scene)
    count, rows = len(place), torch.arange(len(place))
    simulation = TrapperSimulation(count, scene, num_threads=arguments.threads)
    simulation.reset(rows, place, speed)
    arm, base, planner = Arm.ur5(tool_length=scene.tool_length), torch.tensor(scene.base_pos), ik_planner(scene)
    above = waiting_search(scene).goals(future[rows, schedules.meeting])
    held, trapped = torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.bool)
    memory: TensorDict | None = None
    for step in range(int(schedules.meeting.max()) + AFTERWARDS):
        joint_pos = simulation.joint_pos.float()
        pose = arm(joint_pos)
        tool = pose[:, :3, 3] + base
        held = torch.where(is_covered(scene, tool, pose[:, :3, :3], simulation.ball_pos.float()), held + 1, 0)
        trapped |= held >= HOLD_STEPS
        if step < arguments.start:
            simulation.step(torch.zeros(count, 6))
            continue
        ball = future[:, min(step + arguments.follow, future.shape[1] - 1)]
        goal = _goal(maneuver, schedules, step, pulled(tool[:, :2], ball[:, :2], maneuver.pull), above)
        entries = {
            keys.JOINT_POS: joint_pos,
            keys.GOAL: goal,
            keys.STEP_COUNT: torch.full((count,), step - arguments.start),
        }
        if memory is not None:
            entries[keys.PLAN] = memory
        planned = planner(TensorDict(entries, [count]))
        memory = planned[keys.PLAN]
        simulation.step(planned[keys.ACTION])
    return trapped


def _goal(maneuver: WaitAndDrop, schedules: Schedules, step: int, after: Tensor, above: Tensor) -> Tensor:
    """Goals ``(R, 3)`` at ``step``: above the meeting place, from the drop on down, there or ``after`` the ball."""
    level = after.clamp(-maneuver.half_extent, maneuver.half_extent)
    following = schedules.follows & (step >= schedules.drop + maneuver.follow_after)
    level = torch.where(following.unsqueeze(-1), level, above[:, :2])
    down = torch.nn.functional.pad(level, (0, 1), value=maneuver.drop_height)
    return torch.where((step >= schedules.drop).unsqueeze(-1), down, above)


def _meetings(arguments: Arguments, needed: Tensor, future: Tensor, last: int) -> tuple[Tensor, Tensor]:
    """Episode and step of each meeting tried: spread over those that the arm can be in time for."""
    start = arguments.start
    steps = torch.arange(start + max(arguments.leads), last, arguments.spacing)
    ready = (needed[:, steps] + start - SOONEST <= steps) & (future[:, steps, 2] > 0.0)
    number = ready.cumsum(-1)
    stride = (number[:, -1:] / arguments.meetings).ceil().clamp_min(1).long()
    episode, index = (ready & ((number - 1) % stride == 0)).nonzero(as_tuple=True)
    return episode, steps[index]


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper", arguments.scene)
    study = Study(arguments, scene=task.digest())
    names = ("start", "spacing", "meetings", "leads", "follow")
    tried = {name: getattr(arguments, name) for name in names} | {"leads": list(arguments.leads)}
    with measuring():
        for velocity in each(arguments.velocities, "ceiling"):
            setting = Setting(task, arguments, velocity=velocity)
            study.row({**setting.about, **tried}, partial(row_of, arguments, setting, velocity))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
