"""What all tasks of meeting a moving target share as TorchRL environments: numbered episodes, keys, the history."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdyn_plan import keys
from torchdyn_plan.checks import check_choice, check_finite, check_number, check_trailing_shape
from torchdyn_plan.envs.episodes import SPLITS
from torchdyn_plan.envs.specs import flag_spec, observation_spec
from torchdyn_plan.errors import InputError

ENDS = ("done", "terminated", "truncated")
"""Keys that tell whether an episode has ended."""


class RobotReading(NamedTuple):
    """What N robots' sensors read, float32; the environment changes none of these tensors in place afterwards."""

    tool_pos: Tensor
    """``(N, 3)`` [m, world]."""
    state: Tensor
    """``(N, S)``: what a policy and an arrival model read, the tool's place among it."""
    joint_pos: Tensor | None = None
    """``(N, joints)`` [rad]; None for a robot without joints."""
    joint_vel: Tensor | None = None
    """``(N, joints)`` [rad/s]; None for a robot without joints."""


class MovingTargetEnv(EnvBase):
    """N independent episodes of a robot and a target, ``batch_size [num_envs]``, on the CPU.

    Entries are those of `torchdyn_plan.keys` and the task's own `flags`. A task says how an episode starts (`_start`),
    what a control step does (`_advance`), what the robot's sensors read (`_robot`), and what has happened (`_flags`);
    by default any flag ends an episode, and the reward is 1 where the first one holds. How episode i starts must be a
    pure function of (split, seed, i), as `torchdyn_plan.envs.episodes.draw_uniform` draws it: environments take the
    next index when they reset, so that the same actions give bit-identical episodes whatever ``num_envs``.
    """

    flags: ClassVar[tuple[str, ...]] = ()
    """Keys of what the task tells beside, bool ``(N, 1)`` each; the first one is success."""
    scene_digest: str | None = None
    """Hash of the scene, which a planner that was made for one must share; None if there is nothing to confuse."""

    def __init__(
        self,
        num_envs: int = 1,
        *,
        state_size: int,
        action_size: int,
        joints: int = 0,
        static_target: bool = False,
        seed: int = 0,
        split: str = "train",
        history: int = 24,
        max_steps: int = 500,
    ) -> None:
        """Declare the keys, with nothing started yet.

        Args:
            num_envs: number of episodes that run side by side.
            state_size: size S of the robot state.
            action_size: size A of an action, each entry within ±1.
            joints: number of the robot's joints.
            static_target: the target rests, and `goal` says where.
            seed: which series of episodes.
            split: ``train``, ``dev`` or ``test``: series that never share an episode.
            history: length H of `target_history`, in control steps.
            max_steps: control steps after which an episode is truncated.

        Raises:
            InputError: a number is negative, NaN or of the wrong kind, the split is unknown, or the class has no flags.
        """
        if not self.flags:
            raise InputError(f"{type(self).__name__}.flags must name at least what success is called")
        for name, value, minimum in (("num_envs", num_envs, 1), ("history", history, 2), ("max_steps", max_steps, 1)):
            check_number(name, value, minimum=minimum, integer=True)
        check_number("seed", seed, minimum=0, integer=True)
        check_choice("split", split, SPLITS)
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.static_target, self.history, self.max_steps = static_target, history, max_steps
        self.seed, self.split = seed, split
        self._next_episode = 0
        self._episode = torch.zeros(num_envs, dtype=torch.int64)
        # TorchRL's StepCounter and CatFrames would do the next two, at several times the cost of a step.
        self._steps = torch.zeros(num_envs, dtype=torch.int64)
        self._trace = torch.zeros(num_envs, history, 3)
        self.observation_spec = observation_spec(
            num_envs,
            joints=joints,
            state_size=state_size,
            history=history,
            flags=self.flags,
            static_target=static_target,
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=torch.Size((num_envs, action_size)))
        self.reward_spec = Unbounded(torch.Size((num_envs, 1)))
        self.done_spec = Composite({key: flag_spec(num_envs) for key in ENDS}, shape=(num_envs,))

    @abstractmethod
    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        """Start ``episodes`` (M,) in ``rows`` (M,); returns where their targets are, ``(M, 3)`` float32 [m, world]."""

    @abstractmethod
    def _advance(self, action: Tensor) -> Tensor:
        """Let a control step pass under ``action`` (N, A); returns where targets are then, ``(N, 3)`` float32 [m]."""

    @abstractmethod
    def _robot(self) -> RobotReading:
        """What the robots' sensors read now."""

    @abstractmethod
    def _flags(self) -> dict[str, Tensor]:
        """What has happened, bool ``(N,)`` for each of `flags`."""

    def _reward(self, observed: TensorDict) -> Tensor:
        """Rewards ``(N, 1)`` of a step after which ``observed`` is seen: 1 where the first flag holds."""
        return observed[self.flags[0]].float()

    def _terminated(self, observed: TensorDict) -> Tensor:
        """Whether an episode ends of itself, ``(N, 1)`` bool: where any flag holds."""
        return torch.stack([observed[flag] for flag in self.flags]).any(0)

    @property
    def target_pos(self) -> Tensor:
        """Where targets are now, ``(N, 3)`` [m, world]."""
        return self._trace[:, -1]

    @property
    def step_count(self) -> Tensor:
        """Control steps since the reset, ``(N,)`` int64; in `_advance` those before the one that passes."""
        return self._steps

    def start_from(self, episode: int) -> None:
        """Let the next reset take episode number ``episode``, and later ones the numbers after it."""
        check_number("episode", episode, minimum=0, integer=True)
        self._next_episode = episode

    @property
    def next_episode(self) -> int:
        """Number of the episode that the next reset takes."""
        return self._next_episode

    @property
    def num_envs(self) -> int:
        """Number of episodes that run side by side."""
        return self.batch_size[0]

    def check_planner(self, planner: Callable[..., Any]) -> None:
        """Raise `InputError` if ``planner`` was made for another scene, by the digest in its ``scene``."""
        # Any function may be a planner: only those that belong to a scene say so.
        scene = getattr(planner, "scene", None)
        if self.scene_digest is not None and isinstance(scene, str) and scene != self.scene_digest:
            raise InputError(
                f"the planner belongs to scene {scene}, but the environment's scene is {self.scene_digest}: make a "
                "planner for this scene (one that is made with scene=None belongs to none)"
            )

    def rollout(self, max_steps: int, policy: Callable[..., Any] | None = None, *args: Any, **kwargs: Any) -> Any:
        """As TorchRL's; raises `InputError` for a planner of another scene (`check_planner`)."""
        if policy is not None:
            self.check_planner(policy)
        return super().rollout(max_steps, policy, *args, **kwargs)

    def _set_seed(self, seed: int | None) -> None:
        """Start the series ``seed`` at its first episode."""
        self.seed, self._next_episode = seed or 0, 0

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = torch.arange(self.num_envs) if mask is None else mask.reshape(-1).nonzero().squeeze(-1)
        if len(rows):
            episodes = torch.arange(self._next_episode, self._next_episode + len(rows))
            self._next_episode += len(rows)
            self._episode[rows], self._steps[rows] = episodes, 0
            # A copy: what an earlier step returned shares the old one.
            self._trace = self._trace.clone()
            self._trace[rows] = self._start(rows, episodes).unsqueeze(1)
        result = self._observe()
        for key in ENDS:
            result[key] = torch.zeros(self.num_envs, 1, dtype=torch.bool)
        return result

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._see(self._advance(self._checked_action(tensordict)))
        result = self._observe()
        terminated, truncated = self._terminated(result), self._is_over
        result["reward"] = self._reward(result)
        result["terminated"], result["truncated"], result["done"] = terminated, truncated, terminated | truncated
        return result

    def _checked_action(self, tensordict: TensorDictBase) -> Tensor:
        """The action (N, A); raises `InputError` where it has another shape or holds no number."""
        action = tensordict[keys.ACTION]
        check_trailing_shape(keys.ACTION, action, self.num_envs, self.action_spec.shape[-1])
        check_finite(keys.ACTION, action)
        return action

    def _see(self, target: Tensor) -> None:
        """Add ``target`` (N, 3) float32 to the history, and count a step."""
        self._steps += 1
        self._trace = torch.cat([self._trace[:, 1:], target.unsqueeze(1)], dim=1)

    @property
    def _is_over(self) -> Tensor:
        """Whether an episode has had its steps, ``(N, 1)`` bool."""
        return (self._steps >= self.max_steps).unsqueeze(-1)

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """As TorchRL's, without its checks of every entry, which cost more than the step's own arithmetic."""
        after = self._step(tensordict)
        tensordict.set("next", after)
        entries = dict(tensordict.items()) | dict(after.items())
        del entries["next"], entries["reward"]
        done = entries["done"]
        if done.any():
            entries |= dict(self._reset(TensorDict({"_reset": done}, batch_size=self.batch_size)).items())
        return tensordict, TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _observe(self) -> TensorDict:
        robot, target = self._robot(), self.target_pos
        entries = {
            keys.TOOL_POS: robot.tool_pos,
            keys.TARGET_POS: target,
            keys.TARGET_HISTORY: self._trace,
            keys.HISTORY_LENGTH: self._steps.clamp(max=self.history),
            keys.ROBOT_STATE: robot.state,
            keys.OBSERVATION: robot.state,
            keys.ACHIEVED_GOAL: robot.tool_pos,
            keys.DESIRED_GOAL: target,
            keys.STEP_COUNT: self._steps.clone(),
            keys.EPISODE: self._episode.clone(),
        }
        if robot.joint_pos is not None:
            entries[keys.JOINT_POS] = robot.joint_pos
        if robot.joint_vel is not None:
            entries[keys.JOINT_VEL] = robot.joint_vel
        entries |= {key: flag.unsqueeze(-1) for key, flag in self._flags().items()}
        if self.static_target:
            entries[keys.GOAL] = target
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)
