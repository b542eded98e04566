"""Robots driven to goals by a static planner, and nothing else: where arrival times are measured."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number
from torchdyn_plan.envs.moving_target import MovingTargetEnv


class ArmRunner(ABC):
    """N robots with a goal each, and the memory that their static planner keeps from step to step.

    The static planner is any callable from tensordict to tensordict that reads the robot's state and ``goal`` and
    writes ``action``: it is only run and looked at. A task says how robots are put at their start, what they see, how
    they move, and when they are at a goal.
    """

    def __init__(self, planner: Callable[[TensorDictBase], TensorDictBase], num_envs: int) -> None:
        """Let ``planner`` drive ``num_envs`` robots; `reset` puts them at their start."""
        self.planner, self.num_envs = planner, num_envs
        self._forget()

    def _forget(self) -> None:
        self._memory: TensorDict | None = None
        self._steps = torch.zeros(self.num_envs, dtype=torch.int64)

    def reset(self) -> None:
        """Put every robot at its start, all without a memory."""
        self._put_at_start()
        self._forget()

    @abstractmethod
    def _put_at_start(self) -> None:
        """Put every robot at its start."""

    @property
    @abstractmethod
    def robot_state(self) -> Tensor:
        """What a policy or an arrival model reads, ``(N, S)`` float32."""

    @property
    def tool_pos(self) -> Tensor:
        """Where the tools are, ``(N, 3)`` [m, world]."""
        return self._observed()[keys.TOOL_POS]

    @abstractmethod
    def _observed(self) -> dict[str, Tensor]:
        """What a static planner sees of the robots, but for goal, step count and memory."""

    @abstractmethod
    def _drive(self, action: Tensor) -> None:
        """Let a control step pass under ``action`` (N, A)."""

    @abstractmethod
    def is_reached(self, goal: Tensor) -> Tensor:
        """Whether each robot is at ``goal`` (N, 3) [m, world]: ``(N,)`` bool."""

    def step(self, goal: Tensor) -> None:
        """One control step of every robot towards ``goal`` (N, 3) [m, world]."""
        entries = self._observed()
        entries |= {keys.GOAL: goal, keys.DESIRED_GOAL: goal, keys.STEP_COUNT: self._steps}
        if self._memory is not None:
            entries[keys.PLAN] = self._memory
        result = self.planner(TensorDict(entries, batch_size=[self.num_envs]))
        self._memory = result.get(keys.PLAN, None)
        self._steps = self._steps + 1
        self._drive(result[keys.ACTION].detach())


class EnvRunner(ArmRunner):
    """The robots of an environment, driven to goals in place of its targets; its episodes end for nobody."""

    def __init__(
        self, planner: Callable[[TensorDictBase], TensorDictBase], env: MovingTargetEnv, *, radius: float
    ) -> None:
        """Drive the robots of ``env``; one whose tool is within ``radius`` of its goal has arrived [m]."""
        check_number("radius", radius, minimum=0.0)
        self.env, self.radius = env, radius
        super().__init__(planner, env.num_envs)
        self.reset()

    def _put_at_start(self) -> None:
        self._seen = self.env.reset()

    @property
    def robot_state(self) -> Tensor:
        """The environment's, ``(N, S)``."""
        return self._seen[keys.ROBOT_STATE]

    def _observed(self) -> dict[str, Tensor]:
        return dict(self._seen.items())

    def _drive(self, action: Tensor) -> None:
        entries = TensorDict({keys.ACTION: action}, batch_size=self.env.batch_size)
        self._seen = self.env.step(entries)["next"]

    def is_reached(self, goal: Tensor) -> Tensor:
        """Whether each tool is within the radius of ``goal`` (N, 3) [m, world]: ``(N,)`` bool."""
        return (self._seen[keys.TOOL_POS] - goal).norm(dim=-1) <= self.radius
