"""Arrival times by running the static planner: the truth that an ETA network predicts, at the price of a simulation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchdyn_plan.checks import check_trailing_shape
from torchdyn_plan.envs.reaching import ReachingTask
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.nets.eta import Arrival

LONGEST = 300
"""Control steps after which an arm that has not arrived never does."""


class MeasuredArrival(nn.Module):
    """Stands in for an `ETANetwork` of Trapper and tells the truth: it drives copies of the arm to each goal."""

    def __init__(
        self,
        static: Callable[[TensorDictBase], TensorDictBase],
        *,
        scene: TrapperScene | None = None,
        num_threads: int = 0,
    ) -> None:
        """Measure arrivals of ``static`` in ``scene``."""
        super().__init__()
        self.static, self.scene, self.num_threads = static, scene or TrapperScene(), num_threads
        self._tasks: dict[int, ReachingTask] = {}

    def arrival(self, robot_state: Tensor, goal: Tensor, *, reading: Any = None) -> Arrival:
        """Steps and *never* (*B, K) for robot states (*B, 1, 15) and goals (*B, K, 3) [m, world]; nothing to read."""
        check_trailing_shape("robot_state", robot_state, 15)
        check_trailing_shape("goal", goal, 3)
        batch = goal.shape[:-1]
        state = robot_state.expand(*batch, 15).reshape(-1, 15)
        steps = self._run(state, goal.reshape(-1, 3)).view(batch)
        return Arrival(steps.clamp(max=LONGEST).to(goal.dtype), steps > LONGEST)

    def _run(self, state: Tensor, goal: Tensor) -> Tensor:
        """Steps until each arm, from its state (R, 15), is at its goal (R, 3); `LONGEST` + 1 for never."""
        if len(goal) not in self._tasks:
            self._tasks[len(goal)] = ReachingTask(
                self.static, len(goal), scene=self.scene, num_threads=self.num_threads
            )
        task = self._tasks[len(goal)]
        task.reset(state[:, :6], state[:, 6:12])
        arrived = torch.full((len(goal),), LONGEST + 1)
        for step in range(LONGEST + 1):
            arrived = torch.where((arrived > LONGEST) & task.is_reached(goal), step, arrived)
            if bool((arrived <= LONGEST).all()):
                break
            task.step(goal)
        return arrived
