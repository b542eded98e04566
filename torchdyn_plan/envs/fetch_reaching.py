"""Fetch arms driven to goals by a static planner, and nothing else: where arrival times are measured."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.fetch import FetchSimulation
from torchdyn_plan.envs.reach import THRESHOLD, is_at


class FetchReachingTask:
    """``num_envs`` Fetch arms with a goal each, as `torchdyn_plan.envs.reaching.ReachingTask` is for Trapper's."""

    def __init__(
        self,
        planner: Callable[[TensorDictBase], TensorDictBase],
        num_envs: int,
        *,
        threshold: float = THRESHOLD,
        num_threads: int = 0,
    ) -> None:
        """Build the batch with every arm at its start; a gripper within ``threshold`` of its goal has arrived [m]."""
        self.planner, self.threshold = planner, threshold
        self.simulation = FetchSimulation(num_envs, num_threads=num_threads)
        self.reset()

    def reset(self) -> None:
        """Put every arm at its start, all without a memory."""
        count = self.simulation.num_envs
        self.simulation.reset(torch.arange(count))
        self._memory: TensorDict | None = None
        self._steps = torch.zeros(count, dtype=torch.int64)

    @property
    def robot_state(self) -> Tensor:
        """What a policy or an ETA network reads, ``(N, 10)``."""
        return self.simulation.robot_state.float()

    def is_reached(self, goal: Tensor) -> Tensor:
        """Whether each gripper is at ``goal`` (N, 3) [m, world]: ``(N,)`` bool."""
        return is_at(self.simulation.tool_pos, goal, threshold=self.threshold)

    def step(self, goal: Tensor) -> None:
        """One control step of every arm towards ``goal`` (N, 3) [m, world]."""
        state = self.robot_state
        entries = {
            keys.TOOL_POS: state[:, :3], keys.ROBOT_STATE: state, keys.OBSERVATION: state, keys.GOAL: goal,
            keys.DESIRED_GOAL: goal, keys.STEP_COUNT: self._steps,
        }  # fmt: skip
        if self._memory is not None:
            entries[keys.PLAN] = self._memory
        result = self.planner(TensorDict(entries, batch_size=[len(goal)]))
        self._memory, self._steps = result.get(keys.PLAN, None), self._steps + 1
        self.simulation.step(result[keys.ACTION])
