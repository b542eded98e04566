"""Trapper as a TorchRL environment: drop a box over a rolling ball."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.look import Look, Marks
from torchdyn_plan.envs.moving_target import MovingTargetEnv, RobotReading
from torchdyn_plan.envs.painter import Painter
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.envs.trapper.contact import is_covered, is_pocketed
from torchdyn_plan.envs.trapper.keys import POCKETED, TRAPPED
from torchdyn_plan.envs.trapper.reward import GoalReward, goal_reward
from torchdyn_plan.envs.trapper.scene import TrapperScene, trapper_scene
from torchdyn_plan.envs.trapper.simulation import TrapperSimulation
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.kinematics.arm import Arm

HOLD_STEPS = 50
"""Control steps for which a ball must stay covered to count as trapped."""
LAST_HOLD_STEPS = 10
"""The same at the end of an episode, when there is no time for more."""
MAX_STEPS = 500
"""Control steps of an episode: two seconds."""

ROWS = 64
"""Kinematics are computed for a multiple of so many arms."""


class TrapperEnv(MovingTargetEnv):
    """N independent Trapper episodes, ``batch_size [num_envs]``; keys as in `torchdyn_plan.keys`.

    An episode is `terminated` when the ball is trapped (covered for `HOLD_STEPS` steps on end, or for the last
    `LAST_HOLD_STEPS` of the episode) or pocketed, and `truncated` after ``max_steps`` control steps. The reward is 1 in
    the step that traps the ball and 0 elsewhere. With ``static_target`` it is the paper's `goal_reward`, and the step
    that traps the ball brings all that the box would earn there until the end, so that an episode which ends early
    loses nothing.
    Episode i starts as a pure function of (split, seed, i): environments take the next index when they reset, so that
    the same actions give bit-identical episodes whatever ``num_envs`` and ``num_threads``.
    """

    flags = (TRAPPED, POCKETED)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        velocity: float = 3.0,
        friction: float = 0.0,
        static_target: bool = False,
        seed: int | None = None,
        split: str = "train",
        scene: TrapperScene | str | None = None,
        history: int = 24,
        max_steps: int = MAX_STEPS,
        weights: GoalReward | None = None,
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
            velocity: speed of the ball at the start [m/s].
            friction: friction loss on the ball's horizontal translation [N].
            static_target: the ball lies still, and `goal` is where it lies.
            seed: which series of episodes; None for another place in series 0 at every call.
            split: ``train``, ``dev`` or ``test``: series that never share an episode.
            scene: geometry and physics, or the name of a scene; that with a real UR5's limits by default.
            history: length H of `target_history`, in control steps.
            max_steps: control steps after which an episode is truncated.
            weights: of the terms of the reward with ``static_target``.
            num_threads: native threads of the simulation, 0 for all cores.
            goal_in_observation: `observation` ends with the ball's place and, if it rolls, with its last step.
            render_mode: ``rgb_array`` for pictures by `render`.
            on_bad_action: ``raise`` an `InputError` for an action that is no number, or ``hold``: 0 in its row.
            sensor: how the ball is measured; exactly for None.
            device: where entries are shown and actions are expected; the simulation stays on the CPU.

        Raises:
            InputError: a number is negative, NaN or of the wrong kind, or the split or the render mode is unknown.
        """
        check_number("velocity", velocity, minimum=0.0, maximum=20.0)
        check_number("friction", friction, minimum=0.0)
        scene = trapper_scene(scene)
        super().__init__(
            num_envs,
            joints=6,
            state_size=15,
            action_size=6,
            static_target=static_target,
            seed=seed,
            split=split,
            history=history,
            max_steps=max_steps,
            goal_in_observation=goal_in_observation,
            render_mode=render_mode,
            on_bad_action=on_bad_action,
            control_step=scene.control_step,
            sensor=sensor,
            device=device,
        )
        self.scene, self.weights = scene, weights or GoalReward()
        self.scene_digest = self.scene.digest()
        self.velocity, self.friction = 0.0 if static_target else velocity, friction
        self.simulation = TrapperSimulation(num_envs, self.scene, friction=friction, num_threads=num_threads)
        self._arm = Arm.ur5(tool_length=self.scene.tool_length)
        self._base = torch.tensor(self.scene.base_pos)
        self._held = torch.zeros(num_envs, dtype=torch.int64)
        home = torch.tensor(self.scene.home, dtype=torch.float64)
        self._tool_pos, self._tool_rotation = self._tool(home.expand(num_envs, -1))
        self._home_tool = self._tool_pos[0].clone(), self._tool_rotation[0].clone()
        self._painter: Painter | None = None
        self._twin: TrapperSimulation | None = None

    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        place, speed = draw_starts(self.scene, episodes, velocity=self.velocity, split=self.split, seed=self.seed)
        self.simulation.reset(rows, place, speed)
        self._held[rows] = 0
        self._tool_pos[rows], self._tool_rotation[rows] = self._home_tool
        return self.simulation.ball_pos[rows].float()

    def _advance(self, action: Tensor) -> Tensor:
        self.simulation.step(action)
        ball = self.simulation.ball_pos.float()
        self._tool_pos, self._tool_rotation = self._tool(self.simulation.joint_pos)
        covered = is_covered(self.scene, self._tool_pos, self._tool_rotation, ball)
        self._held = torch.where(covered, self._held + 1, 0)
        return ball

    def _reward(self, observed: Mapping[str, Tensor]) -> Tensor:
        trapped = observed[TRAPPED]
        if not self.static_target:
            return trapped.float()
        reward = goal_reward(self.scene, self.weights, self._tool_pos, self._tool_rotation, self._trace[:, -1])
        left = (self.max_steps - self._steps + 1).clamp_min(1)
        return torch.where(trapped, reward * left.unsqueeze(-1), reward)

    def _tool(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Place (N, 3) [m, world] and rotation (N, 3, 3) of the box mouth at joint angles (N, 6) [rad]."""
        # Matrix products treat the last few rows in another way, with another last bit: these are padding.
        padded = nn.functional.pad(joint_pos.float(), (0, 0, 0, -self.num_envs % ROWS))
        pose = self._arm(padded)[: self.num_envs]
        return pose[:, :3, 3] + self._base, pose[:, :3, :3]

    def _robot(self) -> RobotReading:
        joint_pos, joint_vel = self.simulation.joint_pos.float(), self.simulation.joint_vel.float()
        state = torch.cat([joint_pos, joint_vel, self._tool_pos], dim=-1)
        return RobotReading(self._tool_pos, state, joint_pos, joint_vel)

    def _flags(self) -> dict[str, Tensor]:
        enough = torch.where(self._steps < self.max_steps, HOLD_STEPS, LAST_HOLD_STEPS)
        return {TRAPPED: self._held >= enough, POCKETED: is_pocketed(self.scene, self._trace[:, -1])}

    def true_future(self, rows: Tensor, steps: int) -> Tensor:
        """As `MovingTargetEnv.true_future`: arm and box stand still from now on, and the ball may bounce off them."""
        if self._twin is None:
            threads = self.simulation.num_threads
            self._twin = TrapperSimulation(self.num_envs, self.scene, friction=self.friction, num_threads=threads)
        twin, path = self._twin, torch.empty(len(rows), steps, 3)
        twin.hold(self.simulation, rows)
        for step in range(steps):
            twin.step(rows=rows)
            path[:, step] = twin.ball_pos[rows]
        return path

    def look(self) -> Look:
        """As of `MovingTargetEnv`: arm, box, table and ball."""
        camera = {"lookat": (0.0, 0.0, -0.1), "distance": 2.5, "azimuth": 150.0}
        return Look(self.simulation.model, half_side=self.scene.half_side, **camera)

    def posture(self, row: int) -> np.ndarray[Any, Any]:
        """As of `MovingTargetEnv`."""
        return self.simulation.qpos[row].numpy().copy()

    def _picture(self, row: int, width: int, height: int) -> np.ndarray[Any, Any]:
        if self._painter is None:
            self._painter = Painter(self.look())
        return self._painter.picture(self.posture(row), width, height, self._marks(row))

    def _marks(self, row: int) -> list[Marks]:
        """What a picture of environment ``row`` shows in addition to the scene."""
        return []
