"""What all tasks of meeting a moving target share as TorchRL environments: numbered episodes, keys, the history."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdyn_plan import keys
from torchdyn_plan.checks import check_choice, check_finite, check_number, check_trailing_shape
from torchdyn_plan.envs.episodes import SPLITS


class MovingTargetEnv(EnvBase):
    """N independent episodes of a robot and a target, ``batch_size [num_envs]``, on the CPU.

    Entries are those of `torchdyn_plan.keys`. A task says how an episode starts (`_start`), what is seen beside the
    target (`_robot`, `_flags`), and what a step does (`_step`). How episode i starts is a pure function of
    (split, seed, i): environments take the next index when they reset, so that the same actions give bit-identical
    episodes whatever ``num_envs``.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        joints: int,
        state_size: int,
        action_size: int,
        flags: tuple[str, ...],
        static: bool,
        seed: int,
        split: str,
        history: int,
        max_steps: int,
    ) -> None:
        """Declare the keys, with nothing started yet.

        Args:
            num_envs: number of episodes that run side by side.
            joints: number of the robot's joints.
            state_size: size S of the robot state.
            action_size: size A of an action.
            flags: keys of what the task tells beside, bool ``(N, 1)`` each.
            static: the target rests, and `goal` says where.
            seed: which series of episodes.
            split: ``train``, ``dev`` or ``test``: series that never share an episode.
            history: length H of `target_history`, in control steps.
            max_steps: steps after which an episode is truncated.

        Raises:
            InputError: a number is negative, NaN or of the wrong kind, or the split is unknown.
        """
        for name, value, minimum in (("num_envs", num_envs, 1), ("history", history, 2), ("max_steps", max_steps, 1)):
            check_number(name, value, minimum=minimum, integer=True)
        check_number("seed", seed, minimum=0, integer=True)
        check_choice("split", split, SPLITS)
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.static, self.seed, self.split, self.max_steps, self.history = static, seed, split, max_steps, history
        self._next_episode = 0
        self._episode = torch.zeros(num_envs, dtype=torch.int64)
        self._steps = torch.zeros(num_envs, dtype=torch.int64)
        self._trace = torch.zeros(num_envs, history, 3)
        self._make_specs(joints, state_size, action_size, flags)

    def _make_specs(self, joints: int, state_size: int, action_size: int, flags: tuple[str, ...]) -> None:
        n = self.num_envs
        vectors = {
            keys.JOINT_POS: (joints,), keys.JOINT_VEL: (joints,), keys.TOOL_POS: (3,), keys.TARGET_POS: (3,),
            keys.TARGET_HISTORY: (self.history, 3), keys.ROBOT_STATE: (state_size,), keys.OBSERVATION: (state_size,),
            keys.ACHIEVED_GOAL: (3,), keys.DESIRED_GOAL: (3,),
        }  # fmt: skip
        if self.static:
            vectors[keys.GOAL] = (3,)
        one = torch.Size((n, 1))
        specs: dict[str, Any] = {key: Unbounded(torch.Size((n, *shape))) for key, shape in vectors.items()}
        for key in (keys.HISTORY_LENGTH, keys.STEP_COUNT, keys.EPISODE):
            specs[key] = Unbounded(self.batch_size, dtype=torch.int64)
        for key in flags:
            specs[key] = Binary(shape=one, dtype=torch.bool)
        self.observation_spec = Composite(specs, shape=(n,))
        self.action_spec = Bounded(-1.0, 1.0, shape=torch.Size((n, action_size)))
        self.reward_spec = Unbounded(one)
        done = {key: Binary(shape=one, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done, shape=(n,))

    @abstractmethod
    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        """Start ``episodes`` (M,) in ``rows`` (M,); returns where their targets are, ``(M, 3)`` float32 [m, world]."""

    @abstractmethod
    def _robot(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Joint angles and speeds ``(N, joints)``, place of the tool ``(N, 3)`` and robot state ``(N, S)``, float32."""

    @abstractmethod
    def _flags(self) -> dict[str, Tensor]:
        """What the task tells beside, bool ``(N,)`` each."""

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
        for key in ("done", "terminated", "truncated"):
            result[key] = torch.zeros(self.num_envs, 1, dtype=torch.bool)
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
        joint_pos, joint_vel, tool, state = self._robot()
        target = self._trace[:, -1]
        entries = {
            keys.JOINT_POS: joint_pos, keys.JOINT_VEL: joint_vel, keys.TOOL_POS: tool, keys.TARGET_POS: target,
            keys.TARGET_HISTORY: self._trace, keys.HISTORY_LENGTH: self._steps.clamp(max=self.history),
            keys.ROBOT_STATE: state, keys.OBSERVATION: state, keys.ACHIEVED_GOAL: tool, keys.DESIRED_GOAL: target,
            keys.STEP_COUNT: self._steps.clone(), keys.EPISODE: self._episode.clone(),
        }  # fmt: skip
        entries |= {key: flag.unsqueeze(-1) for key, flag in self._flags().items()}
        if self.static:
            entries[keys.GOAL] = target
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)
