"""The smallest world: points that fly where they are pushed, and targets that fly along x."""

import torch
from torch import Tensor

from torchdyn_plan.envs import MovingTargetEnv, RobotReading, draw_uniform

STRIDE = 0.1


class PointEnv(MovingTargetEnv):
    """An action of 1 moves a point by `STRIDE`; targets beyond x = 1 are gone."""

    flags = ("met", "gone")

    def __init__(
        self,
        num_envs: int = 2,
        *,
        speed: float = 0.05,
        scene: str | None = None,
        coordinates: int = 3,
        **series: object,
    ) -> None:
        super().__init__(
            num_envs, state_size=coordinates, action_size=coordinates, coordinates=coordinates, **{"seed": 0, **series}
        )
        self.speed, self.scene_digest = speed, scene
        self.tool_pos, self.target = torch.zeros(2, num_envs, coordinates).unbind(0)

    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        self.tool_pos[rows] = 0.0
        self.target[rows] = draw_uniform(episodes, self.coordinates, split=self.split, seed=self.seed).float()
        return self.target[rows]

    def _advance(self, action: Tensor) -> Tensor:
        self.tool_pos = self.tool_pos + STRIDE * action.clamp(-1.0, 1.0)
        self.target = self.target + self.speed * torch.eye(self.coordinates)[0]
        return self.target

    def _robot(self) -> RobotReading:
        return RobotReading(self.tool_pos, self.tool_pos)

    def _flags(self) -> dict[str, Tensor]:
        met = (self.tool_pos - self.target_pos).norm(dim=-1) < STRIDE
        return {"met": met, "gone": self.target_pos[:, 0] > 1.0}
