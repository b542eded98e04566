"""Catch as a TorchRL environment: a UR10 with a cup meets a ball that is thrown, in the air."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.catch.scene import GRAVITY, CatchScene
from torchdyn_plan.envs.catch.simulation import CatchSimulation
from torchdyn_plan.envs.catch.throws import draw_throws
from torchdyn_plan.envs.catch.ur10 import UR10_LINKS, ur10_arm
from torchdyn_plan.envs.look import Look
from torchdyn_plan.envs.moving_target import MovingTargetEnv, RobotReading
from torchdyn_plan.envs.painter import Painter
from torchdyn_plan.kinematics.flight import braked, fly

if TYPE_CHECKING:
    import numpy as np

CAUGHT, MISSED = "caught", "missed"
"""Flags: the ball has been in the cup for long enough; it is on the floor, and was not."""
ROWS = 64
"""Kinematics are computed for a multiple of so many arms."""
TENNIS = 0.0195
"""Drag of a tennis ball [1/m]: ½ ρ C A / m with C = 0.55."""


class CatchEnv(MovingTargetEnv):
    """N UR10s with a cup each, and a ball that is thrown at each of them.

    The ball is a free body that falls, is slowed down by the air, and touches cup and floor. It is caught once its
    centre has been inside the cup for `CatchScene.hold_steps` control steps on end (`CAUGHT`), and missed when it
    touches the floor (`MISSED`). Its path is a pure function of the episode until something touches it.

    ``tool_pos`` is the middle of the cup's mouth, out of which the tool's z axis points. ``robot_state`` is the joints'
    positions and speeds [rad, rad/s] and the tool's place [m].
    """

    flags = (CAUGHT, MISSED)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        flight: float = 0.7,
        drag: float = TENNIS,
        scene: CatchScene | None = None,
        num_threads: int = 0,
        **series: Any,
    ) -> None:
        """Build the batch.

        Args:
            num_envs: number of episodes that run side by side.
            flight: mean time of flight to the place before the arm that is aimed at [s].
            drag: of the ball, deceleration over speed squared [1/m].
            scene: geometry and physics.
            num_threads: native threads of the simulation, 0 for all cores.
            series: as of `MovingTargetEnv`.

        Raises:
            InputError: a number is out of range.
        """
        check_number("flight", flight, minimum=0.2, maximum=2.0)
        check_number("drag", drag, minimum=0.0, maximum=1.0)
        scene = CatchScene() if scene is None else scene
        fixed: dict[str, Any] = {"control_step": scene.control_step, "max_steps": scene.max_steps, "history": 8}
        count = len(UR10_LINKS)
        super().__init__(num_envs, joints=count, state_size=2 * count + 3, action_size=count, **(fixed | series))
        self.scene, self.flight, self.drag = scene, flight, drag
        self.scene_digest = scene.digest()
        self.simulation = CatchSimulation(num_envs, scene, drag=drag, num_threads=num_threads)
        self._arm = ur10_arm(tool_length=scene.tool_length)
        self._tool_pos, self._tool_rotation = self._tool(self.simulation.joint_pos)
        home = torch.tensor(scene.home, dtype=torch.float64).expand(num_envs, -1)
        self._home = tuple(value[0].clone() for value in self._tool(home))
        self._inside = torch.zeros(num_envs, dtype=torch.int64)
        self._is_down = torch.zeros(num_envs, dtype=torch.bool)
        self._painter: Painter | None = None

    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        how: dict[str, Any] = {"flight": self.flight, "drag": self.drag, "split": self.split, "seed": self.seed}
        place, velocity = draw_throws(self.scene, episodes, **how)
        if self.static_target:
            # A goal that rests is where a ball would fly through.
            path, _ = fly(place, velocity, step=how["flight"], count=1, gravity=GRAVITY, drag=self.drag)
            place, velocity = path[:, 0], torch.zeros_like(velocity)
        self.simulation.reset(rows, place, velocity)
        self._inside[rows], self._is_down[rows] = 0, False
        self._tool_pos[rows], self._tool_rotation[rows] = self._home
        return place.float()

    def _advance(self, action: Tensor) -> Tensor:
        held = self.simulation.ball_pos.clone()
        self.simulation.step(action)
        self._tool_pos, self._tool_rotation = self._tool(self.simulation.joint_pos)
        if self.static_target:
            self.simulation.place_balls(held)
        else:
            self._inside = torch.where(self.is_inside, self._inside + 1, 0)
            # Between two control steps a ball may touch the floor and leave it again.
            self._is_down = self._is_down | (self.simulation.ball_pos[:, 2] <= 1.5 * self.scene.ball_radius)
        return self.simulation.ball_pos.float()

    @property
    def is_inside(self) -> Tensor:
        """Whether the centre of each ball is in its cup, between mouth and bottom, ``(N,)`` bool."""
        way = self.simulation.ball_pos - self._tool_pos.double()
        way = (self._tool_rotation.mT.double() @ way.unsqueeze(-1)).squeeze(-1)
        across, depth = way[:, :2].norm(dim=-1), -way[:, 2]
        return (across <= self.scene.cup_radius) & (depth >= 0.0) & (depth <= self.scene.cup_depth)

    def _tool(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Place (N, 3) [m, world] and rotation (N, 3, 3) of the cups' mouths at joint angles (N, 6) [rad]."""
        # Matrix products treat the last few rows in another way, with another last bit: these are padding.
        pose = self._arm(nn.functional.pad(joint_pos.float(), (0, 0, 0, -self.num_envs % ROWS)))[: self.num_envs]
        place = pose[:, :3, 3] + pose.new_tensor([0.0, 0.0, self.scene.base_height])
        return place, pose[:, :3, :3].clone()

    def _robot(self) -> RobotReading:
        joint_pos, joint_vel = self.simulation.joint_pos.float(), self.simulation.joint_vel.float()
        state = torch.cat([joint_pos, joint_vel, self._tool_pos], dim=-1)
        return RobotReading(self._tool_pos, state, joint_pos, joint_vel)

    def _flags(self) -> dict[str, Tensor]:
        caught = self._inside >= self.scene.hold_steps
        return {CAUGHT: caught, MISSED: self._is_down & ~caught}

    def true_future(self, rows: Tensor, steps: int) -> Tensor:
        """As of `MovingTargetEnv`: the ball flies on, or stays in the cup in which it is."""
        place, velocity = self.simulation.ball_pos[rows], self.simulation.ball_vel[rows]
        # Half a substep's fall is missing, as `CatchSimulation.reset` says.
        falls = braked(velocity, velocity.new_tensor(GRAVITY), self.drag)
        velocity = velocity + 0.5 * self.scene.substep * falls
        path, _ = fly(place, velocity, step=self.scene.control_step, count=steps, gravity=GRAVITY, drag=self.drag)
        return torch.where(self.is_inside[rows, None, None], place.unsqueeze(1), path).float()

    def look(self) -> Look:
        """As of `MovingTargetEnv`: arm, cup and ball."""
        return Look(self.simulation.model, lookat=(1.5, 0.1, 1.2), distance=3.6, azimuth=120.0, elevation=-14.0)

    def posture(self, row: int) -> np.ndarray[Any, Any]:
        """As of `MovingTargetEnv`."""
        return self.simulation.qpos[row].numpy().copy()

    def _picture(self, row: int, width: int, height: int) -> np.ndarray[Any, Any]:
        if self._painter is None:
            self._painter = Painter(self.look())
        return self._painter.picture(self.posture(row), width, height)
