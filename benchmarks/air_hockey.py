"""The Robot Air Hockey Challenge: our planner beside the organisers' baseline agent, on the same starts.

python benchmarks/air_hockey.py --python /tmp/hockey/bin/python --repository /tmp/air_hockey_challenge \
    --out benchmarks/results/air_hockey.json

The challenge runs in an environment of its own (docs/air-hockey.md), and answers over a pipe. Ours is a
`DynamicPlanner` of the package's parts; what knows of mallets and pucks is in this file: `Ahead` of a puck is where a
mallet meets it, and `SoftContact` gives way as it does. Rows are blocks of episodes; a killed study goes on.
"""

from __future__ import annotations

import base64
import gc
import json
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
import tyro
from study import Output, Row, Study, each, measuring, rate_entries, told
from tensordict import TensorDict
from torch import Tensor

from torchdyn_plan.kinematics import Arm
from torchdyn_plan.kinematics.mjcf import joints_of_mjcf
from torchdyn_plan.nets import AnalyticArrival, Billiard
from torchdyn_plan.nets.forecast import Forecast, ForecastModel
from torchdyn_plan.planners import DynamicPlanner, ExactSearch, IKPlanner, MetWithin, ReplanSchedule
from torchdyn_plan.planners.observation import Observation
from torchdyn_plan.planners.plan import Plan
from torchdyn_plan.planners.static.approach import StraightToGoal

HERE = Path(__file__).parent
LIMIT = 20.0
"""An action may take so long [ms]."""
DRAG, RESTITUTION = 0.497, 0.85
"""Of the puck on the table [1/s], and between rims; measured in the challenge's simulation."""
NOWHERE = 100.0
"""Where nothing can be met [m]."""
SIZE = 360, 270
"""Of a picture [pixels]."""
ZONE = -0.8, -0.2
"""A puck that is at rest between these is defended [m, along the table from its middle]."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Play the same starts with each agent."""

    python: Path
    """Interpreter of the challenge's environment."""
    repository: Path | None = None
    """Folder of the organisers' repository, for the baseline."""
    tasks: tuple[str, ...] = ("3dof-defend", "7dof-defend")
    """The challenge's tasks."""
    agents: tuple[str, ...] = ("ours", "baseline")
    """Who plays."""
    episodes: int = 200
    """Starts, a multiple of the block."""
    block: int = 10
    """Of them in a row."""
    series: str = "test"
    """Of the starts: test, or dev while tuning."""
    picture: Path | None = None
    """WebP of our first episodes, drawn in place of a measurement; the challenge's machine needs OpenGL."""


class Challenge:
    """One of the challenge's tasks, in a process of its own that answers line by line."""

    def __init__(self, task: str, arguments: Arguments) -> None:
        """Start it."""
        more = [] if arguments.repository is None else [str(arguments.repository.resolve())]
        command = [str(arguments.python), str(HERE / "air_hockey_side.py"), task, *more]
        env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(command, env=env, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.about = self._answer()

    def ask(self, name: str, *arguments: Any) -> Any:
        """Call a method of its `Side`."""
        assert self.process.stdin
        print(json.dumps([name, arguments]), file=self.process.stdin, flush=True)
        return self._answer()

    def close(self) -> None:
        """Let the process end."""
        assert self.process.stdin
        self.process.stdin.close()
        self.process.wait()

    def _answer(self) -> Any:
        assert self.process.stdout
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("the challenge's process ended; what it said stands above")
        return json.loads(line)


class Ahead(ForecastModel):
    """Forecasts where a mallet is in the way of a puck: a distance ahead of it, along its path.

    Where the puck does not come nearer to the own goal, there is no such place: it is put out of the world's reach.
    """

    def __init__(self, puck: ForecastModel, distance: float) -> None:
        """Be ``distance`` [m] ahead of what ``puck`` forecasts."""
        super().__init__()
        self.puck, self.distance = puck, distance
        self.in_keys = puck.in_keys

    def predict(self, *seen: Tensor) -> Forecast:
        """The puck's path (*B, F, 3), shifted along its tangents."""
        path = self.puck.predict(*seen).path
        before = torch.cat([seen[0][..., -1:, :], path[..., :-1, :]], dim=-2)
        moves = path - before
        returns = (moves[..., :1] >= 0.0).cummax(-2).values
        return Forecast(
            torch.where(returns, NOWHERE, path + self.distance * torch.nn.functional.normalize(moves, dim=-1))
        )


class SoftState(NamedTuple):
    """Where each row's mallet is sent, and what it is about."""

    soft_place: Tensor
    """``(*B, D)`` the goal [m, world]."""
    soft_velocity: Tensor
    """``(*B, D)`` with which it moves [m per control step]."""
    soft_tool: Tensor
    """``(*B, D)`` where the mallet was [m, world]."""
    soft_left: Tensor
    """``(*B,)`` int64 control steps to the contact that it is committed to; -1 for none."""


@dataclass(frozen=True, kw_only=True)
class SoftContact:
    """Waits in the puck's way, and gives way with a share of its speed when they touch.

    Of a puck with speed v that meets a mallet that gives way with w, the speed (1 + e) w - e v is left: none of it for
    w = e v / (1 + e). The last ``swing_steps`` before the contact the goal moves by the cubic from where the mallet is
    to the contact, with both velocities. A puck that comes to rest in the zone by itself is left alone.
    """

    share: float
    """Share w / v of the puck's speed at contact."""
    commit_steps: int
    """A contact that is so many control steps away is kept: where it is follows the forecast, when it is does not."""
    swing_steps: int
    """Control steps in which the mallet takes on its speed."""
    stop_steps: int = 8
    """In which it stops after the contact."""
    horizon: int = 100
    """Control steps of the forecast."""
    zone: tuple[float, float] = (ZONE[0] + 0.03, ZONE[1] - 0.03)
    """A puck that will rest between these is left alone [m, along x]."""
    control_step: float = 0.02
    """[s]"""
    low: tuple[float, ...] = (-0.91, -0.46)
    """Least coordinates of the mallet [m, world]."""
    high: tuple[float, ...] = (-0.15, 0.46)
    """Greatest coordinates."""

    State: ClassVar[type[SoftState]] = SoftState

    @property
    def lookahead(self) -> int:
        """The whole forecast, to read the velocity at the contact."""
        return self.horizon + 1

    @property
    def early_steps(self) -> int:
        """The mallet waits where it would be met so many control steps before the contact: room to take on speed."""
        return round(0.5 * self.share * self.swing_steps)

    def start(self, observation: Observation) -> SoftState:
        """At rest where the mallet is."""
        tool = observation.tool_pos
        return SoftState(tool, torch.zeros_like(tool), tool, torch.full_like(observation.step_count, -1))

    def __call__(
        self, plan: Plan, observation: Observation, holds: Tensor, state: SoftState
    ) -> tuple[Tensor, SoftState]:
        """The goal: where it waits, on its swing, or where it stops."""
        path, tool = plan.ahead(self.lookahead), observation.tool_pos
        acts = self._threatens(observation) & ~holds
        left = (state.soft_left - 1).clamp_min(-1)
        left = torch.where((left < 0) & acts & (plan.arrival_steps <= self.commit_steps), plan.arrival_steps, left)
        steps = left.clamp(1, self.horizon - 1)
        end, after = (path.gather(-2, _rows(index, path)).squeeze(-2) for index in (steps, steps + 1))
        gone = (end - tool).abs().amax(-1) > 0.5 * NOWHERE
        left, acts = left.masked_fill(gone, -1), acts & ~(gone & (left > 0))
        yields = self.share * (after - end)
        swings = ((left > 0) & (left <= self.swing_steps)).unsqueeze(-1)
        fresh = ((state.soft_left <= 0) | (state.soft_left > self.swing_steps)).unsqueeze(-1)
        came = torch.where(fresh, tool, state.soft_place)
        speed = torch.where(fresh, tool - state.soft_tool, state.soft_velocity)
        swung, swing = cubic_step(came, speed, end, yields, steps)
        waits = torch.where((left > 0).unsqueeze(-1), end - 0.5 * self.swing_steps * yields, plan.goal)
        slower = state.soft_velocity * (1.0 - 1.0 / self.stop_steps)
        stops = ((left == 0) | ((left < 0) & ~acts)).unsqueeze(-1)
        place = torch.where(swings, swung, torch.where(stops, state.soft_place + slower, waits))
        velocity = torch.where(swings, swing, torch.where(stops, slower, 0.0))
        level = torch.clamp(place[..., :2], place.new_tensor(self.low), place.new_tensor(self.high))
        place = torch.cat([level, place[..., 2:]], dim=-1)
        return place, SoftState(place, velocity, tool, left)

    def _threatens(self, observation: Observation) -> Tensor:
        """Whether the puck leaves the zone towards the own goal if nobody touches it, ``(*B,)``."""
        history = observation.seen[0][..., 0]
        rest = history[..., -1] + (history[..., -1] - history[..., -2]) / (self.control_step * DRAG)
        return rest < self.zone[0]


def _rows(index: Tensor, path: Tensor) -> Tensor:
    return index[..., None, None].expand(*index.shape, 1, path.shape[-1])


def cubic_step(
    place: Tensor, velocity: Tensor, end: Tensor, end_velocity: Tensor, steps: Tensor
) -> tuple[Tensor, Tensor]:
    """Place and velocity (*B, D) one step on along the cubic that is at ``end`` after ``steps`` (*B,)."""
    count = steps.to(place.dtype).unsqueeze(-1)
    way = end - place
    bend = (6.0 * way / count - 4.0 * velocity - 2.0 * end_velocity) / count
    jerk = (6.0 * (velocity + end_velocity) - 12.0 * way / count) / count.square()
    return place + velocity + bend / 2.0 + jerk / 6.0, velocity + bend + jerk / 2.0


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """What was chosen on starts of the series dev."""

    share: float = 0.33
    """Share of the puck's speed with which the mallet gives way."""
    speed: float = 0.85
    """Share of the joints' speed limits that is used; beyond 0.95 is a violation."""
    within: float = 0.9
    """Share of their position limits; beyond 0.95 is a violation."""
    quick: float = 4.0
    """Acceleration of joints, times what the challenge names and does not ask for."""
    slowdown: float = 1.1
    """Arrivals take so much longer than the limits allow."""
    slack_steps: float = 3.0
    """Control steps by which a mallet may come late to a contact that is kept."""
    commit_steps: int = 15
    """As of `SoftContact`."""
    swing_steps: int = 6
    """As of `SoftContact`."""
    front: float = -0.35
    """The mallet goes no farther to meet a puck [m, along the table from its middle]."""


class Agent:
    """Our planner as the challenge asks it: what is seen in, what the joints are to be and to move at out.

    A speed that changes evenly within each control step never asks for more than the acceleration limit. The joints
    are then half a step behind one that takes on each speed at once, as the planner assumes. So it plans for half a
    step later: there, joints and puck move as it assumes.
    """

    def __init__(self, about: Row, own: Tuning = Tuning()) -> None:
        """Plan for the robot and the table that ``about`` describes."""
        self.about, self.own = about, own
        self.arm = self._arm()
        self.planner = self._planner().eval()
        self.most_change = self.own.quick * about["control_step"] * torch.tensor(about["joint_acc"])
        self._warm_up()
        self.start()

    def start(self) -> None:
        """Begin an episode."""
        self.state = TensorDict(batch_size=[1])
        self.joints: Tensor | None = None
        self.speed = torch.zeros(1, len(self.about["joint_acc"]))
        self.step_number = 0

    def act(self, seen: Row) -> tuple[list[float], list[float]]:
        """Joint positions and speeds at the end of this control step."""
        step, base = self.about["control_step"], self.about["base_x"]
        if self.joints is None:
            self.joints = torch.tensor([seen["joint_pos"]])
        velocity = torch.tensor([[*seen["puck_vel"][:2], 0.0]])
        puck = torch.tensor([[seen["puck_pos"][0] + base, seen["puck_pos"][1], self.about["height"]]])
        puck = puck + 0.5 * step * velocity
        mallet = self.arm(self.joints)[..., :3, 3] + torch.tensor([base, 0.0, 0.0])
        self.state.update(
            {
                "joint_pos": self.joints,
                "tool_pos": mallet,
                "target_pos": puck,
                "target_history": torch.stack([puck - step * velocity, puck], dim=-2),
                "robot_state": torch.cat([self.joints, self.speed], dim=-1),
                "step_count": torch.tensor([self.step_number]),
            }
        )
        self.planner(self.state)
        change = self.state["action"] * self.arm.speed_limit - self.speed
        self.speed = self.speed + change / (change.abs() / self.most_change).amax(-1, keepdim=True).clamp_min(1.0)
        self.joints = self.joints + step * self.speed
        self.step_number += 1
        return (self.joints - 0.5 * step * self.speed)[0].tolist(), self.speed[0].tolist()

    def _warm_up(self) -> None:
        """Act a few times on a puck that stands: what is done only once takes no time of an episode."""
        self.start()
        still = {"joint_pos": [0.0] * len(self.about["joint_acc"]), "puck_pos": [0.0, 0.0], "puck_vel": [0.0, 0.0]}
        with torch.no_grad():
            for _ in range(3):
                self.act(still)

    def _arm(self) -> Arm:
        """The robot, with limits a little within those of the challenge."""
        joints = joints_of_mjcf(self.about["file"], base=self.about["base"], tip=self.about["mallet"])
        within = self.own.within
        joints = [replace(joint, lower=within * joint.lower, upper=within * joint.upper) for joint in joints]
        return Arm(joints, speed_limit=[self.own.speed * speed for speed in self.about["joint_vel"]])

    def _planner(self) -> DynamicPlanner:
        about, arm, step = self.about, self.arm, self.about["control_step"]
        base = (about["base_x"], 0.0, 0.0)
        quick = [self.own.quick * value for value in about["joint_acc"]]
        static = IKPlanner(
            arm, approach=StraightToGoal(base_pos=base), control_step=step, acceleration=quick, damping=0.005
        )
        sides = [side / 2.0 - about["puck_radius"] for side in (about["length"], about["width"])]
        maneuver = SoftContact(
            share=self.own.share,
            commit_steps=self.own.commit_steps,
            swing_steps=self.own.swing_steps,
            control_step=step,
        )
        puck = Billiard(sides, horizon=maneuver.horizon, control_step=step, restitution=RESTITUTION, drag=DRAG)
        return DynamicPlanner(
            static,
            Ahead(puck, about["puck_radius"] + about["mallet_radius"]),
            AnalyticArrival(
                static,
                speed=arm.speed_limit,
                acceleration=quick,
                control_step=step,
                slowdown=self.own.slowdown,
                extra_steps=-self.own.slack_steps,
            ),
            search=ExactSearch(
                stride=1,
                first=1,
                switching_cost=1.0,
                margin=self.own.slack_steps,
                early_steps=maneuver.early_steps,
                descent_steps=maneuver.swing_steps,
            ),
            schedule=ReplanSchedule.every(1, first_step=0),
            maneuver=maneuver,
            lost=MetWithin(low=(-0.86, -0.49, -1.0), high=(self.own.front, 0.49, 1.0)),
        )


@contextmanager
def undisturbed() -> Iterator[None]:
    """No garbage is collected meanwhile, but before: to look through all that torch has loaded takes too long."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def play(
    challenge: Challenge,
    agent: Agent,
    series: str,
    episode: int,
    *,
    each_step: Callable[[int], None] = lambda step: None,
) -> Row:
    """One episode of ours, as `Side.baseline` tells of the baseline's; ``each_step`` is called before each."""
    seen = challenge.ask("reset", series, episode)
    agent.start()
    milliseconds: list[list[float]] = []
    violated: set[str] = set()
    with undisturbed():
        while True:
            each_step(len(milliseconds))
            begun = time.perf_counter(), time.process_time()
            action = agent.act(seen)
            taken = time.perf_counter() - begun[0], time.process_time() - begun[1]
            milliseconds.append([1e3 * seconds for seconds in taken])
            seen = challenge.ask("step", *action)
            violated.update(seen["violated"])
            if seen["over"]:
                return {"success": seen["success"], "violated": sorted(violated), "milliseconds": milliseconds}


def draw(challenge: Challenge, agent: Agent, arguments: Arguments, *, episodes: int = 3, every: int = 2) -> None:
    """Write a moving picture of some episodes, one after the other."""
    from PIL import Image

    assert arguments.picture is not None
    frames: list[Image.Image] = []

    def frame() -> None:
        picture = base64.b64decode(challenge.ask("picture", *SIZE))
        frames.append(Image.frombytes("RGB", SIZE, picture))

    for episode in range(episodes):
        play(challenge, agent, arguments.series, episode, each_step=lambda step: frame() if step % every == 0 else None)
        frames.extend([frames[-1]] * 15)
    pause = int(1000 * every * challenge.about["control_step"])
    frames[0].save(
        arguments.picture, save_all=True, append_images=frames[1:], duration=pause, loop=0, quality=60, method=6
    )


def measure(challenge: Challenge, agent: Agent | None, series: str, first: int, count: int) -> Row:
    """A block of episodes: which are lost, what is violated in each, and its actions' times; None for the baseline."""
    played = []
    for episode in range(first, first + count):
        if agent is None:
            played.append(challenge.ask("baseline", series, episode))
        else:
            played.append(play(challenge, agent, series, episode))
    times = np.concatenate([row["milliseconds"] for row in played])
    return {
        "lost": [first + number for number, row in enumerate(played) if not row["success"]],
        "violated": [row["violated"] for row in played if row["violated"]],
        "actions": len(times),
        **timing("ms", times[:, 0]),
        **timing("processor_ms", times[:, 1]),
    }


def timing(name: str, milliseconds: np.ndarray[Any, Any]) -> Row:
    """Mean and greatest of times (A,) of actions, and how many took too long."""
    high = {"mean": milliseconds.mean(), "max": milliseconds.max()}
    late = {f"{name}_late": int((milliseconds > LIMIT).sum())}
    return {f"{name}_{what}": float(value) for what, value in high.items()} | late


def summary(rows: Sequence[Row]) -> Row:
    """Figures of all blocks of an agent in a task."""
    episodes, actions = sum(row["block"] for row in rows), sum(row["actions"] for row in rows)
    violated = [names for row in rows for names in row["violated"]]
    found = {
        "episodes": episodes,
        **rate_entries("success", episodes - sum(len(row["lost"]) for row in rows), episodes),
        "episodes_with_violations": len(violated),
        "violations": {name: sum(name in names for names in violated) for name in sorted(set().union(*violated))},
    }
    for name in ("ms", "processor_ms"):
        found[f"{name}_mean"] = sum(row[f"{name}_mean"] * row["actions"] for row in rows) / actions
        found[f"{name}_max"] = max(row[f"{name}_max"] for row in rows)
        found[f"{name}_late"] = sum(row[f"{name}_late"] for row in rows) / actions
    return found


def main(arguments: Arguments) -> None:
    """Play, save and print."""
    if arguments.picture is not None:
        challenge = Challenge(arguments.tasks[0], arguments)
        with measuring():
            draw(challenge, Agent(challenge.about), arguments)
        challenge.close()
        return
    study = Study(arguments)
    challenges = {task: Challenge(task, arguments) for task in arguments.tasks}
    ours = {task: Agent(challenge.about) for task, challenge in challenges.items()}
    pairs = [(task, agent) for task in arguments.tasks for agent in arguments.agents]
    with measuring():
        for first in each(range(0, arguments.episodes, arguments.block), "blocks"):
            for task, agent in pairs:
                about = {"task": task, "agent": agent, "series": arguments.series}
                about |= {"first": first, "block": arguments.block}
                player = ours[task] if agent == "ours" else None
                given = challenges[task], player, arguments.series, first, arguments.block
                study.row(about, partial(measure, *given))
    found = []
    for task, agent in pairs:
        own = {"task": task, "agent": agent, "series": arguments.series}
        found.append(own | summary([row for row in study.rows if own.items() <= row.items()]))
        print(told(found[-1]))
    study.save(summary=found)
    for challenge in challenges.values():
        challenge.close()


if __name__ == "__main__":
    main(tyro.cli(Arguments))
