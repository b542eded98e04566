"""Robots driven to goals by a static planner, and nothing else: where arrival times are measured."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import POSE_SIZE, check_number, check_trailing_shape
from torchdyn_plan.envs.moving_target import MovingTargetEnv
from torchdyn_plan.errors import InputError


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
        """One control step of every robot towards ``goal`` (N, 3) [m, world], or towards a ``goal_pose`` (N, 7)."""
        entries, place = self._observed(), goal
        if goal.shape[-1] == POSE_SIZE:
            entries[keys.GOAL_POSE], place = goal, goal[:, :3]
        entries |= {keys.GOAL: place, keys.DESIRED_GOAL: place, keys.STEP_COUNT: self._steps}
        if self._memory is not None:
            entries[keys.PLAN] = self._memory
        result = self.planner(TensorDict(entries, batch_size=[self.num_envs]))
        self._memory = result.get(keys.PLAN, None)
        self._steps = self._steps + 1
        self._drive(result[keys.ACTION].detach())


class EnvRunner(ArmRunner):
    """The robots of an environment, driven to goals in place of its targets; its episodes end for nobody."""

    def __init__(
        self,
        planner: Callable[[TensorDictBase], TensorDictBase],
        env: MovingTargetEnv,
        *,
        radius: float | None = None,
        at_goal: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> None:
        """Drive the robots of ``env``.

        Args:
            planner: static planner.
            env: their environment.
            radius: a robot whose tool is within it of its goal has arrived [m].
            at_goal: says instead which robots have arrived, for goals that are poses: from the joints' positions (N, J)
                and the goals (N, 7) to ``(N,)`` bool.

        Raises:
            InputError: the radius is no such number, or there are both or neither.
        """
        if (radius is None) == (at_goal is None):
            raise InputError(f"EnvRunner needs either a radius or at_goal, got {radius!r} and {at_goal!r}")
        if radius is not None:
            check_number("radius", radius, minimum=0.0)
        self.env, self.radius, self.at_goal = env, radius, at_goal
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
        """Whether each tool is within the radius of ``goal`` (N, 3) [m, world], or as `at_goal` says: ``(N,)`` bool."""
        if self.at_goal is not None:
            return self.at_goal(self._seen[keys.JOINT_POS], goal)
        return (self._seen[keys.TOOL_POS] - goal).norm(dim=-1) <= self.radius


class FunctionRunner(ArmRunner):
    """Robots that a person's own functions start and move: a simulator, a Gymnasium environment, a laboratory."""

    def __init__(
        self,
        planner: Callable[[TensorDictBase], TensorDictBase],
        *,
        start: Callable[[], Mapping[str, Tensor]],
        step: Callable[[Tensor], Mapping[str, Tensor]],
        radius: float,
    ) -> None:
        """Drive the N robots that ``start`` puts at their start.

        Args:
            planner: static planner.
            start: starts all robots, and returns what the planner sees of them: at least ``tool_pos`` (N, 3) [m, world]
                and ``robot_state`` (N, S).
            step: lets a control step pass under an action (N, A), and returns the same entries.
            radius: a robot whose tool is within it of its goal has arrived [m].

        Raises:
            InputError: the functions return other entries, or the radius is no such number.
        """
        check_number("radius", radius, minimum=0.0)
        self.start_robots, self.step_robots, self.radius = start, step, radius
        self._seen = self._checked(start(), "start")
        super().__init__(planner, len(self._seen[keys.TOOL_POS]))

    @classmethod
    def of_gym(cls, planner: Callable[[TensorDictBase], TensorDictBase], envs: Any, *, radius: float) -> FunctionRunner:
        """Drive the robots of a vector of Gymnasium environments.

        Args:
            planner: static planner.
            envs: a ``gymnasium.vector.VectorEnv`` with the observations of goal environments: ``observation`` (N, S)
                is the robot's state, ``achieved_goal`` (N, 3) the tool's place [m]. Its own goals are not looked at.
                Its episodes must be longer than the sequences of runs.
            radius: a robot whose tool is within it of its goal has arrived [m].

        Raises:
            InputError: observations are others; later, an episode ended.
        """

        def entries(observation: Any) -> dict[str, Tensor]:
            names = {keys.ROBOT_STATE: "observation", keys.TOOL_POS: "achieved_goal"}
            missing = [name for name in names.values() if name not in observation]
            if missing:
                raise InputError(f"observations of the environments lack {', '.join(missing)}")
            return {key: torch.tensor(observation[name], dtype=torch.float32) for key, name in names.items()}

        def step(action: Tensor) -> dict[str, Tensor]:
            observation, _, terminated, truncated, _ = envs.step(action.cpu().numpy())
            if terminated.any() or truncated.any():
                raise InputError("an episode of the environments ended within a sequence of runs: lift its time limit")
            return entries(observation)

        return cls(planner, start=lambda: entries(envs.reset()[0]), step=step, radius=radius)

    def _put_at_start(self) -> None:
        self._seen = self._checked(self.start_robots(), "start")

    @property
    def robot_state(self) -> Tensor:
        """What the functions say, ``(N, S)``."""
        return self._seen[keys.ROBOT_STATE]

    def _observed(self) -> dict[str, Tensor]:
        return dict(self._seen)

    def _drive(self, action: Tensor) -> None:
        self._seen = self._checked(self.step_robots(action), "step")

    def is_reached(self, goal: Tensor) -> Tensor:
        """Whether each tool is within the radius of ``goal`` (N, 3) [m, world]: ``(N,)`` bool."""
        return (self._seen[keys.TOOL_POS] - goal).norm(dim=-1) <= self.radius

    @staticmethod
    def _checked(entries: Mapping[str, Tensor], function: str) -> Mapping[str, Tensor]:
        missing = [key for key in (keys.TOOL_POS, keys.ROBOT_STATE) if key not in entries]
        if missing:
            raise InputError(f"what {function} returns lacks {', '.join(missing)}")
        state = entries[keys.ROBOT_STATE]
        check_trailing_shape(keys.TOOL_POS, entries[keys.TOOL_POS], len(state), entries[keys.TOOL_POS].shape[-1])
        return entries
