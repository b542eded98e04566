"""Dynamic FetchReach as a TorchRL environment: bring the Fetch gripper to a goal that moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice, check_number
from torchdyn_plan.envs.fetch_reach.goal_motion import MOTIONS, GoalStarts, draw_goals, goal_places
from torchdyn_plan.envs.fetch_reach.keys import REACHED
from torchdyn_plan.envs.fetch_reach.simulation import ARM_JOINTS, CONTROL_STEP, FetchSimulation, fetch_digest
from torchdyn_plan.envs.look import Ball, Look, Marks
from torchdyn_plan.envs.moving_target import MovingTargetEnv, RobotReading
from torchdyn_plan.envs.painter import Painter
from torchdyn_plan.envs.sensor import Sensor

MAX_STEPS = 50
"""Control steps of an episode: two seconds."""
THRESHOLD = 0.01
"""A gripper within this distance of its goal has reached it [m]."""
DHER_RANGE, FETCH_RANGE = 0.1, 0.15
"""How far from the gripper goals on lines start along either axis, in DHER and in FetchReach [m]."""
STATE_SIZE = 10
"""Entries of the robot state, which is FetchReach's observation; the gripper's place comes first."""


def is_at(tool_pos: Tensor, goal: Tensor, *, threshold: float = THRESHOLD) -> Tensor:
    """Whether a gripper at ``tool_pos`` (*B, 3) is within ``threshold`` of ``goal`` (*B, 3) [m]: ``(*B,)`` bool."""
    return (goal - tool_pos).norm(dim=-1) <= threshold


def reach_reward(tool_pos: Tensor, goal: Tensor, *, threshold: float = THRESHOLD) -> Tensor:
    """0 at the goal and -1 elsewhere, float32 ``(*B, 1)``: what both the step and hindsight give."""
    return is_at(tool_pos, goal, threshold=threshold).float().unsqueeze(-1) - 1.0


class DynamicReachEnv(MovingTargetEnv):
    """N independent episodes of reaching a moving goal, ``batch_size [num_envs]``; as in DHER.

    The order of a step is DHER's (Fang et al., ICLR 2019): first the goal moves by ``velocity``, but not while the
    gripper is at it; then the action and the physics; then reward and observation. The reward is 0 at the goal and -1
    elsewhere. An episode is never `terminated`, and `truncated` after ``max_steps``; it is a success if the gripper is
    at the goal after *any* step, which ``reached`` tells. Keys are those of `torchdyn_plan.keys`; an action is a pull
    along x, y and z, and a fourth entry for the fingers, which stay shut. Episode i starts as a pure function of
    (split, seed, i), whatever ``num_envs`` and ``num_threads``.
    """

    flags = (REACHED,)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        velocity: float = 0.011,
        motion: str = "straight",
        static_target: bool = False,
        threshold: float = THRESHOLD,
        goal_range: float | None = None,
        seed: int | None = None,
        split: str = "train",
        history: int = 8,
        max_steps: int = MAX_STEPS,
        num_threads: int = 0,
        goal_in_observation: bool = False,
        render_mode: str | None = None,
        on_bad_action: str = "raise",
        sensor: Sensor | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        """Build the batch.

        Args:
            num_envs: number of episodes that run side by side.
            velocity: how far the goal moves in a control step [m].
            motion: ``straight`` along +x, ``circle``, or ``random``: straight in a level direction of the episode's.
            static_target: FetchReach's own task: the goal rests, at any height, and `goal` says where.
            threshold: distance from the goal that counts as being there [m].
            goal_range: goals on lines start within this of the gripper along each axis [m]; 0.1 as in DHER, and 0.15
                as in FetchReach for ``static_target``.
            seed: which series of episodes; None for another place in series 0 at every call.
            split: ``train``, ``dev`` or ``test``: series that never share an episode.
            history: length H of `target_history`, in control steps.
            max_steps: control steps after which an episode is truncated.
            num_threads: native threads of the simulation, 0 for all cores.
            goal_in_observation: `observation` ends with the goal's place and, if it moves, with its last step.
            render_mode: ``rgb_array`` for pictures by `render`.
            on_bad_action: ``raise`` an `InputError` for an action that is no number, or ``hold``: 0 in its row.
            sensor: how the goal is measured; exactly for None.
            device: where entries are shown and actions are expected; the simulation stays on the CPU.

        Raises:
            InputError: a number is negative, NaN or of the wrong kind, the split or the motion is unknown, or
                gymnasium-robotics, which has the model, is not installed.
        """
        check_number("velocity", velocity, minimum=0.0, maximum=1.0)
        check_number("threshold", threshold, minimum=1e-6)
        check_choice("motion", motion, MOTIONS)
        if goal_range is None:
            goal_range = FETCH_RANGE if static_target else DHER_RANGE
        check_number("goal_range", goal_range, minimum=0.0)
        super().__init__(
            num_envs,
            joints=len(ARM_JOINTS),
            state_size=STATE_SIZE,
            action_size=4,
            static_target=static_target,
            seed=seed,
            split=split,
            history=history,
            max_steps=max_steps,
            goal_in_observation=goal_in_observation,
            render_mode=render_mode,
            on_bad_action=on_bad_action,
            control_step=CONTROL_STEP,
            sensor=sensor,
            device=device,
        )
        self.scene_digest = fetch_digest()
        self.velocity, self.motion = 0.0 if static_target else velocity, motion
        self.threshold, self.goal_range = threshold, goal_range
        self.simulation = FetchSimulation(num_envs, num_threads=num_threads)
        self._moves = torch.zeros(num_envs, dtype=torch.int64)
        self._reached = torch.zeros(num_envs, dtype=torch.bool)
        self._painter: Painter | None = None
        place = torch.zeros(num_envs, 3, dtype=torch.float64)
        self._starts = GoalStarts(place, torch.zeros(num_envs, dtype=torch.float64))

    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        self.simulation.reset(rows)
        starts = draw_goals(
            episodes,
            self.simulation.start.tool_pos,
            motion=self.motion,
            goal_range=self.goal_range,
            split=self.split,
            seed=self.seed,
            level=not self.static_target,
        )
        for old, new in zip(self._starts, starts, strict=True):
            old[rows] = new
        self._moves[rows] = 0
        self._goal = self._places()
        self._reached[rows] = False
        return self._goal[rows].float()

    def _advance(self, action: Tensor) -> Tensor:
        # A goal that the gripper is at stays until the gripper has left it.
        self._moves += ~self._is_there()
        self._goal = self._places()
        self.simulation.step(action)
        self._reached = self._reached | self._is_there()
        return self._goal.float()

    def _is_there(self) -> Tensor:
        return is_at(self.simulation.tool_pos, self._goal, threshold=self.threshold)

    def _reward(self, observed: Mapping[str, Tensor]) -> Tensor:
        return reach_reward(self.simulation.tool_pos, self._goal, threshold=self.threshold)

    def _terminated(self, observed: Mapping[str, Tensor]) -> Tensor:
        return torch.zeros(self.num_envs, 1, dtype=torch.bool)

    def _places(self) -> Tensor:
        return goal_places(self._starts, self._moves, motion=self.motion, velocity=self.velocity)

    def _robot(self) -> RobotReading:
        simulation, state = self.simulation, self.simulation.robot_state.float()
        return RobotReading(state[:, :3], state, simulation.joint_pos.float(), simulation.joint_vel.float())

    def _flags(self) -> dict[str, Tensor]:
        return {REACHED: self._reached}

    def look(self) -> Look:
        """As of `MovingTargetEnv`: the arm; the goal is no part of the model."""
        model = self.simulation.model
        # The model's own mark of a goal does not move.
        model.site("target0").rgba[3] = 0.0
        goal = Ball(0.02, (0.9, 0.1, 0.1, 1.0))
        return Look(model, lookat=(1.1, 0.75, 0.5), distance=1.8, azimuth=130.0, half_side=0.5, target=goal)

    def posture(self, row: int) -> np.ndarray[Any, Any]:
        """As of `MovingTargetEnv`."""
        return self.simulation.qpos[row].numpy().copy()

    def _picture(self, row: int, width: int, height: int) -> np.ndarray[Any, Any]:
        look = self.look()
        if self._painter is None:
            self._painter = Painter(look)
        assert look.target is not None
        goal = Marks.ball(tuple(self._goal[row].tolist()), *look.target)
        return self._painter.picture(self.posture(row), width, height, [goal])
