"""Conveyor as a TorchRL environment: a Panda picks parts off a moving belt."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.conveyor.panda import panda_arm
from torchdyn_plan.envs.conveyor.scene import MOST_PARTS, ConveyorScene
from torchdyn_plan.envs.conveyor.simulation import ConveyorSimulation
from torchdyn_plan.envs.episodes import draw_uniform
from torchdyn_plan.envs.look import Look
from torchdyn_plan.envs.moving_target import MovingTargetEnv, RobotReading
from torchdyn_plan.envs.painter import Painter
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError

if TYPE_CHECKING:
    import numpy as np

TAKEN, PASSED = "taken", "passed"
"""Flags: every part was taken; no part is left on the belt, and at least one was not taken."""
PARTS_TAKEN = "parts_taken"
"""Entry: which parts were taken, bool ``(N, K)``."""
ROWS = 64
"""Kinematics are computed for a multiple of this many arms."""
CLOSEST = 0.12
"""Smallest distance between parts, however slow the belt is [m]."""


def draw_parts(
    scene: ConveyorScene, episodes: Tensor, *, parts: int, speed: float, split: str, seed: int
) -> tuple[Tensor, Tensor]:
    """Start of the parts of ``episodes`` (M,): x and y ``(M, K, 2)`` [m], and yaw ``(M, K)`` [rad], float64.

    All are uniform: the first part's position upstream, the time between parts, the position across the lane, the yaw.
    """
    drawn = draw_uniform(episodes, 3 * MOST_PARTS, split=split, seed=seed).view(-1, MOST_PARTS, 3)[:, :parts]
    share = 0.5 + 0.5 * drawn[..., 0]
    first = scene.first_from + share[:, :1] * (scene.first_to - scene.first_from)
    feed = (scene.feed_from + share[:, 1:] * (scene.feed_to - scene.feed_from)) * speed
    y = first - torch.nn.functional.pad(feed.clamp_min(CLOSEST).cumsum(-1), (1, 0))
    x = scene.belt_x + drawn[..., 1] * scene.lane_half_width
    return torch.stack([x, y], dim=-1), math.pi * drawn[..., 2]


class ConveyorEnv(MovingTargetEnv):
    """N Pandas with suction cups, each above a belt with K parts at any yaw.

    The cups attach to a part when its top is at their mouth, at the same speed and orientation, within the limits of
    `ConveyorScene`; the part is then welded to the tool. A part lifted off the belt is taken and removed: placing it is
    not part of the task. An episode is a success when all its parts are taken (`TAKEN`), and fails when the remaining
    parts have passed (`PASSED`).

    ``targets_pos``, ``targets_history`` and ``targets_quat`` cover all parts, and ``targets_present`` tells which are
    still to be taken: parts that were taken or are gone leave their slots empty. A part's position is the centre of its
    top. ``target_pos`` and the like are those of the part farthest downstream. ``robot_state`` is the joints' positions
    and speeds [rad, rad/s] and the tool position [m].
    """

    flags = (TAKEN, PASSED)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        speed: float = 0.35,
        parts: int = 1,
        scene: ConveyorScene | None = None,
        num_threads: int = 0,
        **series: Any,
    ) -> None:
        """Build the batch.

        Args:
            num_envs: number of episodes that run side by side.
            speed: of the belt [m/s].
            parts: of an episode, K.
            scene: geometry and physics.
            num_threads: native threads of the simulation, 0 for all cores.
            series: as of `MovingTargetEnv`.

        Raises:
            InputError: a number is out of range, or a sensor is given: it handles one target only.
        """
        sensor = series.get("sensor")
        if isinstance(sensor, Sensor) and not sensor.is_exact:
            raise InputError(
                "sensor must be None: it measures one target, and this environment shows the positions of all parts"
            )
        check_number("speed", speed, minimum=0.0, maximum=2.0)
        check_number("parts", parts, minimum=1, maximum=MOST_PARTS, integer=True)
        scene = ConveyorScene() if scene is None else scene
        fixed: dict[str, Any] = {"control_step": scene.control_step, "max_steps": scene.max_steps, "history": 8}
        fixed |= series
        super().__init__(
            num_envs,
            joints=7,
            state_size=17,
            action_size=7,
            others={
                keys.TARGET_QUAT: ((4,), torch.float32),
                keys.TARGETS_PRESENT: ((parts,), torch.bool),
                keys.TARGETS_POS: ((parts, 3), torch.float32),
                keys.TARGETS_HISTORY: ((parts, fixed["history"], 3), torch.float32),
                keys.TARGETS_QUAT: ((parts, 4), torch.float32),
                PARTS_TAKEN: ((parts,), torch.bool),
            },
            **fixed,
        )
        self.scene, self.parts, self.speed = scene, parts, 0.0 if self.static_target else speed
        self.scene_digest = scene.digest()
        self.simulation = ConveyorSimulation(num_envs, scene, speed=self.speed, parts=parts, num_threads=num_threads)
        self._arm = panda_arm(tool_length=scene.tool_length)
        home = torch.tensor(scene.home, dtype=torch.float64).expand(num_envs, -1)
        self._tool_pos, self._tool_rotation = self._tool(home)
        self._home = self._tool_pos[0].clone(), self._tool_rotation[0].clone()
        self._histories = torch.zeros(num_envs, parts, self.history, 3)
        self._near, self._focus = torch.zeros(num_envs, parts, dtype=torch.int64), torch.zeros(num_envs).long()
        self._held, self._taken, self._gone = torch.zeros(3, num_envs, parts, dtype=torch.bool).unbind(0)
        self._painter: Painter | None = None

    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        how: dict[str, Any] = {"parts": self.parts, "speed": self.speed, "split": self.split, "seed": self.seed}
        self.simulation.reset(rows, *draw_parts(self.scene, episodes, **how))
        for value in (self._near, self._held, self._taken, self._gone, self._focus):
            value[rows] = 0
        self._tool_pos[rows], self._tool_rotation[rows] = self._home
        places = self._tops[rows].float()
        self._histories[rows] = places.unsqueeze(-2)
        return places[:, 0]

    def _advance(self, action: Tensor) -> Tensor:
        self.simulation.step(action)
        before, time = self._tool_pos, self.scene.control_step
        self._tool_pos, self._tool_rotation = self._tool(self.simulation.joint_pos)
        self._grip((self._tool_pos - before) / time)
        places = self._tops.float()
        self._histories = torch.cat([self._histories[..., 1:, :], places.unsqueeze(-2)], dim=-2)
        present = self.present
        far = torch.where(present, places[..., 1], -torch.inf).argmax(-1)
        focus = torch.where(present.any(-1), far, self._focus)
        rows = (focus != self._focus).nonzero().squeeze(-1)
        # The history shown is that of the part shown; the newest position is added later.
        self._trace[rows, 1:] = self._histories[rows, focus[rows]][:, :-1]
        self._focus = focus
        return places[torch.arange(self.num_envs), focus]

    def _grip(self, tool_vel: Tensor) -> None:
        """Attach, take and drop parts, with tools moving at ``tool_vel`` (N, 3) [m/s]."""
        scene, tops = self.scene, self._tops
        near = (tops - self._tool_pos.unsqueeze(1)).norm(dim=-1) <= scene.hold_distance
        near &= (self.simulation.part_vel - tool_vel.unsqueeze(1)).norm(dim=-1) <= scene.hold_speed
        near &= self._is_aligned & self.present & ~self._held.any(-1, keepdim=True)
        self._near = torch.where(near, self._near + 1, 0)
        new = self._near >= scene.hold_steps
        # At most one part at a time.
        new &= new.long().cumsum(-1) == 1
        self.simulation.hold(new, self._tool_pos, self._tool_rotation)
        self._held = self._held | new
        lifted = self._held & (tops[..., 2] >= scene.top + scene.lift_height)
        gone = self.present & ~self._held & (tops[..., 1] >= scene.gone_y)
        self.simulation.park(lifted | gone)
        self._taken, self._gone = self._taken | lifted, self._gone | gone
        self._held = self._held & ~lifted

    @property
    def _is_aligned(self) -> Tensor:
        """Whether the tool points down and is aligned with each part, up to a half turn: ``(N, K)`` bool."""
        least = math.cos(math.radians(self.scene.hold_angle))
        rotation = self._tool_rotation.double()
        down = -rotation[:, 2, 2] >= least
        quat = self.simulation.part_quat
        yaw = 2.0 * torch.atan2(quat[..., 3], quat[..., 0])
        along = rotation[:, None, 0, 0] * yaw.cos() + rotation[:, None, 1, 0] * yaw.sin()
        return down.unsqueeze(-1) & (along.abs() >= least)

    @property
    def present(self) -> Tensor:
        """Parts still to be taken, ``(N, K)`` bool."""
        return ~self._taken & ~self._gone

    @property
    def _tops(self) -> Tensor:
        """Centres of the parts' tops, ``(N, K, 3)`` float64 [m]; parts lie flat, or hang from the tool."""
        up = torch.tensor([0.0, 0.0, 0.5 * self.scene.part_size[2]], dtype=torch.float64)
        return self.simulation.part_pos + up

    def _tool(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Position (N, 3) [m] and rotation (N, 3, 3) of the cups' mouth at joint angles (N, 7) [rad]."""
        # Matrix products may round the last few rows differently, so these rows are padding.
        pose = self._arm(nn.functional.pad(joint_pos.float(), (0, 0, 0, -self.num_envs % ROWS)))[: self.num_envs]
        return pose[:, :3, 3].clone(), pose[:, :3, :3].clone()

    def _robot(self) -> RobotReading:
        joint_pos, joint_vel = self.simulation.joint_pos.float(), self.simulation.joint_vel.float()
        state = torch.cat([joint_pos, joint_vel, self._tool_pos], dim=-1)
        return RobotReading(self._tool_pos, state, joint_pos, joint_vel)

    def _flags(self) -> dict[str, Tensor]:
        all_taken = self._taken.all(-1)
        return {TAKEN: all_taken, PASSED: ~self.present.any(-1) & ~all_taken}

    def _others(self) -> dict[str, Tensor]:
        quats = self.simulation.part_quat.float()
        return {
            keys.TARGET_QUAT: quats[torch.arange(self.num_envs), self._focus],
            keys.TARGETS_PRESENT: self.present,
            keys.TARGETS_POS: self._histories[..., -1, :].clone(),
            keys.TARGETS_HISTORY: self._histories.clone(),
            keys.TARGETS_QUAT: quats,
            PARTS_TAKEN: self._taken.clone(),
        }

    def true_future(self, rows: Tensor, steps: int) -> Tensor:
        """See `MovingTargetEnv`: the belt carries the part on."""
        now = self._trace[rows, -1]
        way = self.speed * self.scene.control_step * torch.arange(1, steps + 1, dtype=now.dtype)
        return now.unsqueeze(1) + nn.functional.pad(way.unsqueeze(-1), (1, 1))

    def look(self) -> Look:
        """See `MovingTargetEnv`: arm, belt and parts."""
        return Look(self.simulation.model, lookat=(0.3, -0.05, 0.25), distance=1.9, azimuth=205.0)

    def posture(self, row: int) -> np.ndarray[Any, Any]:
        """As of `MovingTargetEnv`."""
        return self.simulation.qpos[row].numpy().copy()

    def _picture(self, row: int, width: int, height: int) -> np.ndarray[Any, Any]:
        if self._painter is None:
            self._painter = Painter(self.look())
        return self._painter.picture(self.posture(row), width, height)
