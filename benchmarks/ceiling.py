"""What any schedule could trap: each solvable episode tried with many meeting and drop times, the truth known.

A schedule waits above the place where the ball will truly be at step t and lets the box down some steps before, either
there or after the ball. It starts at step 13, as planners do, and is simulated. The ceiling is the share of solvable
episodes that at least one schedule traps.

python benchmarks/ceiling.py --out benchmarks/results/ceiling.json
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
import tyro
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments
from torchdyn_plan.envs.episodes import draw_starts
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.simulation import TrapperSimulation
from torchdyn_plan.envs.trapper import HOLD_STEPS, MAX_STEPS
from torchdyn_plan.envs.trapping import is_covered
from torchdyn_plan.evaluation.intervals import rate
from torchdyn_plan.evaluation.planners import static_planner
from torchdyn_plan.evaluation.play import one_thread
from torchdyn_plan.evaluation.run import record_truth
from torchdyn_plan.evaluation.solvability import arrival_map
from torchdyn_plan.files import write_json
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.planners import IKPlanner
from torchdyn_plan.planners.meeting import FOLLOW_AFTER, WAITING, pulled
from torchdyn_plan.versions import library_versions, machine

START = 13
"""Step at which a schedule starts, and until which the arm stays at home."""
PULL = 0.044
"""A box that follows is sent so far ahead of itself at most [m], as `MeetingPlanner` does."""
SOONEST = 12
"""A schedule is tried where the arm would be down at the place this many steps late, at worst."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Measure the ceiling."""

    velocities: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """[m/s]"""
    episodes: int = 200
    """Episodes a velocity; the solvable ones of them are tried."""
    spacing: int = 3
    """Control steps between meeting times."""
    meetings: int = 32
    """Meeting times of an episode that are tried at most, evenly among those in reach."""
    leads: tuple[int, ...] = (5, 8, 11, 14, 17)
    """Control steps before the meeting at which the box is let down."""
    follow: int = 7
    """A box that follows is sent to where the ball is so many steps later."""
    split: str = "test"
    """Series of episodes."""
    rows: int = 4096
    """Schedules simulated side by side."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores."""
    out: Path | None = None
    """JSON file for the figures."""


def ceiling(arguments: Arguments, velocity: float) -> dict[str, Any]:
    """Share of solvable episodes that a schedule traps, and how many of the schedules tried for one do."""
    scene, setting = TrapperScene(), _setting(arguments, velocity)
    future, solvable = record_truth(setting)
    arrivals = arrival_map("ik", static_planner("ik"), scene)
    future = future[solvable]
    place, speed = draw_starts(scene, solvable.nonzero().squeeze(-1), velocity=velocity, split=arguments.split, seed=0)
    episode, meeting = _meetings(arguments, arrivals.at(future[:, : MAX_STEPS + 1]), future)
    grid = torch.cartesian_prod(torch.arange(len(episode)), torch.tensor(arguments.leads), torch.tensor([0, 1]))
    pair, lead, follows = grid.unbind(-1)
    episode, meeting = episode[pair], meeting[pair]
    order = meeting.argsort(stable=True)
    trapped = torch.zeros(len(order), dtype=torch.bool)
    for rows in tqdm(order.split(arguments.rows), desc=f"{velocity:g} m/s", leave=False):
        which = episode[rows]
        schedules = Schedules(meeting[rows], meeting[rows] - lead[rows], follows[rows].bool())
        balls = place[which], speed[which], future[which]
        trapped[rows] = simulate(scene, balls, schedules, ahead=arguments.follow, threads=arguments.threads)
    hits = torch.zeros(len(future)).index_add_(0, episode, trapped.float())
    tried = torch.zeros(len(future)).index_add_(0, episode, torch.ones(len(episode)))
    share = rate(int((hits > 0).sum()), len(future))
    still = torch.zeros(len(future)).index_add_(0, episode, (trapped & (follows == 0)).float())
    return {
        "velocity": velocity, "solvable": len(future), "ceiling": share.value, "ci": [share.low, share.high],
        "without following": float((still > 0).float().mean()), "schedules": len(order),
        "share of schedules that trap": float((hits / tried.clamp_min(1)).mean()),
    }  # fmt: skip


class Schedules(NamedTuple):
    """What is done in each row, ``(R,)`` each."""

    meeting: Tensor
    """Step whose place of the ball is waited above."""
    drop: Tensor
    """Step at which the box is let down."""
    follows: Tensor
    """Whether it then follows the ball."""


def simulate(
    scene: TrapperScene, balls: tuple[Tensor, Tensor, Tensor], schedules: Schedules, *, ahead: int, threads: int
) -> Tensor:
    """Whether each schedule traps its ball, ``(R,)``.

    Args:
        scene: where it happens.
        balls: start ``(R, 2)``, velocity ``(R, 2)`` and true path ``(R, T, 3)`` of each row's.
        schedules: one a row.
        ahead: a box that follows is sent to where the ball is so many steps later.
        threads: of the simulation.
    """
    (place, speed, future), (meeting, drop, follows) = balls, schedules
    count, rows = len(place), torch.arange(len(place))
    simulation = TrapperSimulation(count, scene, num_threads=threads)
    simulation.reset(rows, place, speed)
    arm, base, planner = Arm.ur5(tool_length=scene.tool_length), torch.tensor(scene.base_pos), IKPlanner()
    above = WAITING.goals(future[rows, meeting])
    held, trapped = torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.bool)
    memory: TensorDict | None = None
    for step in range(int(meeting.max()) + 40):
        joint_pos = simulation.joint_pos.float()
        pose = arm(joint_pos)
        tool = pose[:, :3, 3] + base
        held = torch.where(is_covered(scene, tool, pose[:, :3, :3], simulation.ball_pos.float()), held + 1, 0)
        trapped |= held >= HOLD_STEPS
        if step < START:
            simulation.step(torch.zeros(count, 6))
            continue
        after = future[:, min(step + ahead, future.shape[1] - 1)]
        level = pulled(tool[:, :2], after[:, :2], PULL).clamp(-WAITING.half_extent, WAITING.half_extent)
        level = torch.where((follows & (step >= drop + FOLLOW_AFTER)).unsqueeze(-1), level, above[:, :2])
        down = torch.nn.functional.pad(level, (0, 1), value=scene.ball_radius)
        goal = torch.where((step >= drop).unsqueeze(-1), down, above)
        entries = {keys.JOINT_POS: joint_pos, keys.GOAL: goal, keys.STEP_COUNT: torch.full((count,), step)}
        if memory is not None:
            entries[keys.PLAN] = memory
        planned = planner(TensorDict(entries, [count]))
        memory = planned[keys.PLAN]
        simulation.step(planned[keys.ACTION])
    return trapped


def _meetings(arguments: Arguments, needed: Tensor, future: Tensor) -> tuple[Tensor, Tensor]:
    """Episode and step of each meeting tried: spread over those that the arm can be in time for."""
    steps = torch.arange(START + max(arguments.leads), MAX_STEPS, arguments.spacing)
    ready = (needed[:, steps] + START - SOONEST <= steps) & (future[:, steps, 2] > 0.0)
    number = ready.cumsum(-1)
    stride = (number[:, -1:] / arguments.meetings).ceil().clamp_min(1).long()
    episode, index = (ready & ((number - 1) % stride == 0)).nonzero(as_tuple=True)
    return episode, steps[index]


def _setting(arguments: Arguments, velocity: float) -> EvaluateArguments:
    return EvaluateArguments(
        velocity=velocity, episodes=arguments.episodes, split=arguments.split, threads=arguments.threads
    )


if __name__ == "__main__":
    arguments = tyro.cli(Arguments)
    with torch.no_grad(), one_thread():
        rows = [ceiling(arguments, velocity) for velocity in arguments.velocities]
    for row in rows:
        print(row)
    if arguments.out is not None:
        about = {"machine": machine(), "versions": library_versions(), "scene": TrapperScene().digest()}
        write_json(arguments.out, about | {"arguments": dataclasses.asdict(arguments) | {"out": None}, "rows": rows})
