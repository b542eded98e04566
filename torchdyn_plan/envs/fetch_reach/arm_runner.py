"""Fetch arms driven to goals by a static planner, and nothing else."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.arm_runner import ArmRunner
from torchdyn_plan.envs.fetch_reach.env import THRESHOLD, is_at
from torchdyn_plan.envs.fetch_reach.simulation import FetchSimulation


class FetchArmRunner(ArmRunner):
    """``num_envs`` Fetch arms with a goal each."""

    def __init__(
        self,
        planner: Callable[[TensorDictBase], TensorDictBase],
        num_envs: int,
        *,
        threshold: float = THRESHOLD,
        num_threads: int = 0,
    ) -> None:
        """Build the batch with every arm at its start; a gripper within ``threshold`` of its goal has arrived [m]."""
        super().__init__(planner, num_envs)
        self.threshold = threshold
        self.simulation = FetchSimulation(num_envs, num_threads=num_threads)
        self.reset()

    def _put_at_start(self) -> None:
        self.simulation.reset(torch.arange(self.num_envs))

    @property
    def robot_state(self) -> Tensor:
        """What a policy or an ETA network reads, ``(N, 10)``."""
        return self.simulation.robot_state.float()

    def _observed(self) -> dict[str, Tensor]:
        state = self.robot_state
        return {keys.TOOL_POS: state[:, :3], keys.ROBOT_STATE: state, keys.OBSERVATION: state}

    def _drive(self, action: Tensor) -> None:
        self.simulation.step(action)

    def is_reached(self, goal: Tensor) -> Tensor:
        """Whether each gripper is at ``goal`` (N, 3) [m, world]: ``(N,)`` bool."""
        return is_at(self.simulation.tool_pos, goal, threshold=self.threshold)
