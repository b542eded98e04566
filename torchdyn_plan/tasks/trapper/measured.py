"""Arrival times by running the static planner: the truth that an ETA network predicts, at the price of a simulation."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan.checks import check_trailing_shape
from torchdyn_plan.envs.trapper.arm_runner import TrapperArmRunner
from torchdyn_plan.envs.trapper.scene import TrapperScene, trapper_scene
from torchdyn_plan.nets.arrival import Arrival, ArrivalModel
from torchdyn_plan.tasks.trapper.data import run_plan
from torchdyn_plan.training.runs import first_as_near

LONGEST = 300
"""Control steps after which an arm that has not arrived never does."""


class MeasuredArrival(ArrivalModel):
    """Stands in for an `ETANetwork` of Trapper and tells the truth: it drives copies of the arm to each goal."""

    def __init__(
        self,
        static: Callable[[TensorDictBase], TensorDictBase],
        *,
        scene: TrapperScene | str | None = None,
        nearest: bool = False,
        num_threads: int = 0,
    ) -> None:
        """Measure arrivals of ``static`` in ``scene``.

        With ``nearest`` none is *never*: to a place out of reach it is the time until the arm is as near as it gets.
        """
        super().__init__()
        self.nearest = nearest
        self.static, self.scene, self.num_threads = static, trapper_scene(scene), num_threads
        self._arms: dict[int, TrapperArmRunner] = {}

    def arrival(self, robot_state: Tensor, goal: Tensor, *, estimator: str = "mode") -> Arrival:
        """Steps and *never* (*B, K) for robot states (*B, 1, 15) and goals (*B, K, 3) [m, world], by any estimator."""
        check_trailing_shape("robot_state", robot_state, 15)
        check_trailing_shape("goal", goal, 3)
        batch = goal.shape[:-1]
        state = robot_state.expand(*batch, 15).reshape(-1, 15)
        steps = self._run(state, goal.reshape(-1, 3)).view(batch)
        return Arrival(steps.clamp(max=LONGEST).to(goal.dtype), steps > LONGEST)

    def _run(self, state: Tensor, goal: Tensor) -> Tensor:
        """Steps until each arm, from its state (R, 15), is at its goal (R, 3); `LONGEST` + 1 for never."""
        count = len(goal)
        if count not in self._arms:
            driven = TrapperArmRunner(self.static, count, scene=self.scene, num_threads=self.num_threads)
            self._arms[count] = driven
        arms = self._arms[count]
        arms.reset(state[:, :6], state[:, 6:12])
        plan = run_plan(self.scene)
        assert plan.at_rest is not None
        arrived, tools = torch.full((count,), LONGEST + 1), []
        for step in range(LONGEST + 1):
            arrived = torch.where((arrived > LONGEST) & arms.is_reached(goal), step, arrived)
            tools.append(arms.tool_pos)
            # At rest elsewhere it comes no nearer.
            resting = plan.at_rest(arms.robot_state) & self.nearest & (step > plan.starting)
            if bool(((arrived <= LONGEST) | resting).all()):
                break
            arms.step(goal)
        if not self.nearest:
            return arrived
        nearest = first_as_near(torch.stack(tools), goal)
        return torch.where(arrived <= LONGEST, arrived, nearest)
