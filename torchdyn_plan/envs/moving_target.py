"""Base class of TorchRL environments with a moving target: numbered episodes, keys, the target's history."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdyn_plan import keys
from torchdyn_plan.checks import POINT_SIZES, check_choice, check_finite, check_number, check_trailing_shape
from torchdyn_plan.envs.episodes import SPLITS, somewhere
from torchdyn_plan.envs.sensing import Sensed, Sensing
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.envs.specs import flag_spec, observation_spec
from torchdyn_plan.errors import InputError

if TYPE_CHECKING:
    from torchdyn_plan.envs.look import Look

ENDS = ("done", "terminated", "truncated")
"""Keys that mark the end of an episode."""


RENDER_MODES = ("rgb_array",)
"""Modes of `MovingTargetEnv.render`."""
ON_BAD_ACTION = ("raise", "hold")
"""Treatment of a NaN or infinite action: an error before anything moves, or 0 in its row."""


class RobotReading(NamedTuple):
    """Readings of N robots' sensors, float32; the environment returns copies of these tensors."""

    tool_pos: Tensor
    """``(N, D)`` [m, world]."""
    state: Tensor
    """``(N, S)``: input of policies and arrival models; includes the tool's position."""
    joint_pos: Tensor | None = None
    """``(N, joints)`` [rad]; None for a robot without joints."""
    joint_vel: Tensor | None = None
    """``(N, joints)`` [rad/s]; None for a robot without joints."""


class MovingTargetEnv(EnvBase):
    """N independent episodes of a robot and a target, ``batch_size [num_envs]``, simulated on the CPU.

    Entries are those of `torchdyn_plan.keys` and the task's own `flags`. A task defines how an episode starts
    (`_start`), what a control step does (`_advance`), the readings of the robot's sensors (`_robot`), and the flags
    (`_flags`); by default any flag ends an episode, and the reward is 1 if the first one holds. The start of episode i
    must be a pure function of (split, seed, i), for example drawn by `torchdyn_plan.envs.episodes.draw_uniform`:
    environments take the next index when they reset, so that the same actions give bit-identical episodes for any
    ``num_envs``.

    Actions are detached, and no returned tensor shares memory with the environment or with another entry, so it may be
    changed in place. `state_dict` stores the position in the series; an environment that loads it restarts the
    interrupted episodes at its next reset and continues from there.
    """

    flags: ClassVar[tuple[str, ...]] = ()
    """Keys of the task's flags, bool ``(N, 1)`` each; the first one is success."""
    scene_digest: str | None = None
    """Hash of the scene, which must match that of a planner made for a scene; None if the task has only one."""

    def __init__(
        self,
        num_envs: int = 1,
        *,
        state_size: int,
        action_size: int,
        joints: int = 0,
        coordinates: int = 3,
        static_target: bool = False,
        seed: int | None = None,
        split: str = "train",
        history: int = 24,
        max_steps: int = 500,
        goal_in_observation: bool = False,
        render_mode: str | None = None,
        on_bad_action: str = "raise",
        control_step: float | None = None,
        sensor: Sensor | None = None,
        others: Mapping[str, tuple[tuple[int, ...], torch.dtype]] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        """Declare the keys, with nothing started yet.

        Args:
            num_envs: number of parallel episodes.
            state_size: size S of the robot state.
            action_size: size A of an action, each entry within ±1.
            joints: number of the robot's joints.
            coordinates: D of every position, 2 in a plane or 3 in space.
            static_target: the target rests at `goal`.
            seed: which series of episodes, from its first one; None for series 0 from a random position far into it, so
                that copies made without a seed play different episodes.
            split: ``train``, ``dev`` or ``test``: series that never share an episode.
            history: length H of `target_history`, in control steps.
            max_steps: control steps after which an episode is truncated.
            goal_in_observation: append the target's position (D) [m, world] and, unless it rests, its last step (D) [m]
                to `observation`, for scripts that pass a policy nothing else.
            render_mode: ``rgb_array`` for pictures by `render`; None for none.
            on_bad_action: what to do with NaN or infinite actions: ``raise`` for an `InputError` before anything moves,
                ``hold`` for an action of 0 in that row.
            control_step: time between two actions [s]; needed for a sensor.
            sensor: how the target is measured; exactly for None. With another sensor `target_pos` is the newest
                measurement, `target_history` its values at the last control steps, and `measured_pos`, `measured_time`
                and `true_target_pos` are added. Rewards and flags use the true position.
            others: trailing shape and type of each entry of `_others`.
            device: device of entries and actions; the simulation stays on the CPU.

        Raises:
            InputError: a number is negative, NaN or of the wrong kind, the split or the render mode is unknown, or the
                class has no flags.
        """
        if not self.flags:
            raise InputError(f"{type(self).__name__}.flags must name at least the flag of success")
        for name, value, minimum in (("num_envs", num_envs, 1), ("history", history, 2), ("max_steps", max_steps, 1)):
            check_number(name, value, minimum=minimum, integer=True)
        check_number("coordinates", coordinates, minimum=POINT_SIZES[0], maximum=POINT_SIZES[-1], integer=True)
        check_choice("split", split, SPLITS)
        if render_mode is not None:
            check_choice("render_mode", render_mode, RENDER_MODES)
        check_choice("on_bad_action", on_bad_action, ON_BAD_ACTION)
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.static_target, self.history, self.max_steps = static_target, history, max_steps
        self.coordinates = coordinates
        self.split, self.goal_in_observation, self.render_mode = split, goal_in_observation, render_mode
        self.on_bad_action, self.control_step, self.sensor = on_bad_action, control_step, sensor
        self._process = os.getpid()
        self._begin_series(seed)
        self._episode = torch.zeros(num_envs, dtype=torch.int64)
        # TorchRL's StepCounter and CatFrames would do the next two at several times the cost of a step.
        self._steps = torch.zeros(num_envs, dtype=torch.int64)
        self._trace = torch.zeros(num_envs, history, coordinates)
        self._sensing = self._make_sensing()
        if self._sensing is not None:
            self._held_trace, self._sensed = self._trace.clone(), self._sensing.nothing()
        shown = 0 if not goal_in_observation else coordinates if static_target else 2 * coordinates
        self.observation_spec = observation_spec(
            num_envs,
            joints=joints,
            state_size=state_size,
            observation_size=state_size + shown,
            history=history,
            coordinates=coordinates,
            flags=self.flags,
            static_target=static_target,
            measurements=0 if self._sensing is None else self._sensing.slots,
            others=others or {},
        ).to(self.device)
        action = Bounded(-1.0, 1.0, shape=torch.Size((num_envs, action_size)), dtype=torch.float32)
        self.action_spec = action.to(self.device)
        self.reward_spec = Unbounded(torch.Size((num_envs, 1))).to(self.device)
        ends = Composite({key: flag_spec(num_envs) for key in ENDS}, shape=(num_envs,))
        self.done_spec = ends.to(self.device)

    def _make_sensing(self) -> Sensing | None:
        """The batch's sensors; None if the target is measured exactly."""
        sensor = self.sensor
        if sensor is not None and not isinstance(sensor, Sensor):
            raise InputError(f"sensor must be a Sensor or None, got {type(sensor).__name__}")
        if sensor is None or sensor.is_exact:
            return None
        if self.static_target:
            raise InputError("sensor must be None with static_target: a goal at rest is given, not measured")
        if self.control_step is None:
            raise InputError(f"{type(self).__name__} needs its control_step [s] for a sensor, got None")
        return Sensing(
            sensor,
            self.num_envs,
            coordinates=self.coordinates,
            control_step=self.control_step,
            max_steps=self.max_steps,
        )

    @abstractmethod
    def _start(self, rows: Tensor, episodes: Tensor) -> Tensor:
        """Start ``episodes`` (M,) in ``rows`` (M,); returns their targets' positions ``(M, D)`` float32 [m, world]."""

    @abstractmethod
    def _advance(self, action: Tensor) -> Tensor:
        """Simulate a control step under ``action`` (N, A); returns the targets' positions ``(N, D)`` float32 [m]."""

    @abstractmethod
    def _robot(self) -> RobotReading:
        """Present readings of the robots' sensors."""

    @abstractmethod
    def _flags(self) -> dict[str, Tensor]:
        """Values of the `flags`, bool ``(N,)`` each."""

    def _others(self) -> dict[str, Tensor]:
        """Further entries of a task, by the keys of its ``others``; tensors that are not used elsewhere."""
        return {}

    def true_future(self, rows: Tensor, steps: int) -> Tensor:
        """Future positions of the targets of ``rows`` (M,) if the robots stand still: ``(M, steps, D)`` [m, world].

        Entry k is k + 1 control steps ahead. It is simulated from the present state, on the CPU.

        Raises:
            InputError: the environment cannot simulate ahead.
        """
        raise InputError(f"{type(self).__name__} cannot simulate ahead")

    def _picture(self, row: int, width: int, height: int) -> np.ndarray[Any, Any]:
        """A picture of environment ``row`` now, ``(height, width, 3)`` uint8; for tasks that support it."""
        raise InputError(f"{type(self).__name__} draws no pictures")

    def look(self) -> Look:
        """How the world is drawn; by default tool and target as balls above a floor."""
        from torchdyn_plan.envs.look import TARGET, TOOL, Ball, Look, bare_floor

        tool, target, half_side = Ball(0.04, TOOL), Ball(0.03, TARGET), 2.0
        return Look(bare_floor(half_side), distance=4.0, elevation=-50.0, half_side=half_side, tool=tool, target=target)

    def posture(self, row: int) -> np.ndarray[Any, Any]:
        """Present generalised positions ``(nq,)`` of environment ``row``, for the model of `look`."""
        return np.zeros(0)

    def _reward(self, observed: Mapping[str, Tensor]) -> Tensor:
        """Rewards ``(N, 1)`` of a step that leads to ``observed``: 1 where the first flag holds."""
        return observed[self.flags[0]].float()

    def _terminated(self, observed: Mapping[str, Tensor]) -> Tensor:
        """Whether an episode terminates, ``(N, 1)`` bool: where any flag holds."""
        return torch.stack([observed[flag] for flag in self.flags]).any(0)

    @property
    def target_pos(self) -> Tensor:
        """Present positions of the targets, ``(N, D)`` [m, world]."""
        return self._trace[:, -1]

    @property
    def step_count(self) -> Tensor:
        """Control steps since the reset, ``(N,)`` int64; in `_advance`, without the step being simulated."""
        return self._steps

    def start_from(self, episode: int) -> None:
        """Let the next reset take episode number ``episode``, and later ones the numbers after it."""
        check_number("episode", episode, minimum=0, integer=True)
        self._next_episode = episode
        self._again.fill_(-1)

    @property
    def next_episode(self) -> int:
        """Number of the episode that the next reset takes."""
        return self._next_episode

    @property
    def num_envs(self) -> int:
        """Number of parallel episodes."""
        return self.batch_size[0]

    def check_planner(self, planner: Callable[..., Any]) -> None:
        """Raise `InputError` if ``planner`` was made for another scene, by the digest in its ``scene``."""
        # Any function may be a planner; only planners made for a scene have a digest.
        scene = getattr(planner, "scene", None)
        if self.scene_digest is not None and isinstance(scene, str) and scene != self.scene_digest:
            raise InputError(
                f"the planner belongs to scene {scene}, but the environment's scene is {self.scene_digest}: make a "
                "planner for this scene (a planner made with scene=None fits any)"
            )

    def rollout(self, max_steps: int, policy: Callable[..., Any] | None = None, *args: Any, **kwargs: Any) -> Any:
        """Like TorchRL's; raises `InputError` for a planner of another scene (`check_planner`)."""
        if policy is not None:
            self.check_planner(policy)
        return super().rollout(max_steps, policy, *args, **kwargs)

    def render(self, *, row: int | None = None, width: int = 320, height: int = 240) -> np.ndarray[Any, Any]:
        """Pictures of all environments now, ``(N, height, width, 3)`` uint8, or of environment ``row`` without the N.

        Raises:
            InputError: the environment was made without ``render_mode="rgb_array"``, there is no such row, or this
                machine cannot draw.
        """
        if self.render_mode is None:
            raise InputError("render needs an environment that was made with render_mode='rgb_array', got None")
        if row is not None:
            check_number("row", row, minimum=0, maximum=self.num_envs - 1, integer=True)
            return self._picture(row, width, height)
        return np.stack([self._picture(row, width, height) for row in range(self.num_envs)])

    def get_extra_state(self) -> dict[str, Any]:
        """Position in the series, for `state_dict`: its seed, the episodes in progress, and the next episode."""
        return {"seed": self.seed, "next_episode": self._next_episode, "episodes": self._episode.clone()}

    def set_extra_state(self, state: Any) -> None:
        """Continue the series of ``state``: the next reset restarts the episodes that were in progress.

        Raises:
            InputError: the state is of an environment with another number of parallel episodes.
        """
        check_trailing_shape("episodes of the state", state["episodes"], self.num_envs)
        self.seed, self._next_episode = state["seed"], state["next_episode"]
        self._again.copy_(state["episodes"])

    def load_state_dict(self, state_dict: Any, *args: Any, **kwargs: Any) -> Any:
        """Like PyTorch's; an empty state, as some collectors store for an environment, changes nothing."""
        return super().load_state_dict(state_dict, *args, **kwargs) if state_dict else None

    def _set_seed(self, seed: int | None) -> None:
        """Start the series ``seed`` at its first episode; for None, series 0 at a random position."""
        self._begin_series(seed)

    def _begin_series(self, seed: int | None) -> None:
        if seed is not None:
            check_number("seed", seed, minimum=0, integer=True)
        self.seed, self._next_episode = seed or 0, somewhere() if seed is None else 0
        # Episodes that rows must restart because they were in progress when a state was saved; -1 for none.
        self._again = torch.full((self.num_envs,), -1, dtype=torch.int64)

    def _take_episodes(self, rows: Tensor) -> Tensor:
        """Numbers of the episodes that ``rows`` (M,) start: ``(M,)``."""
        episodes = self._again[rows]
        new = (episodes < 0).nonzero().squeeze(-1)
        episodes[new] = torch.arange(self._next_episode, self._next_episode + len(new))
        self._next_episode += len(new)
        self._again[rows] = -1
        return episodes

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        self._check_process()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = torch.arange(self.num_envs) if mask is None else mask.cpu().reshape(-1).nonzero().squeeze(-1)
        if len(rows):
            episodes = self._take_episodes(rows)
            self._episode[rows], self._steps[rows] = episodes, 0
            place = self._start(rows, episodes)
            self._trace[rows] = place.unsqueeze(1)
            if self._sensing is not None:
                self._start_sensing(self._sensing, rows, episodes, place)
        return self._shown(self._observe() | {key: torch.zeros(self.num_envs, 1, dtype=torch.bool) for key in ENDS})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_process()
        self._see(self._advance(self._checked_action(tensordict)))
        seen = self._observe()
        terminated, truncated = self._terminated(seen), self._is_over
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return self._shown(seen | ends | {"reward": self._reward(seen)})

    def _shown(self, entries: dict[str, Tensor]) -> TensorDictBase:
        """``entries`` on the output device: the only move between devices."""
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _check_process(self) -> None:
        """Raise `InputError` in another process than the environment's: a simulation's threads survive no fork."""
        if os.getpid() != self._process:
            raise InputError(
                f"the environment was built in process {self._process}, and process {os.getpid()} uses it: build it in "
                "the process that uses it, as ParallelEnv does with a function that makes one"
            )

    def _checked_action(self, tensordict: TensorDictBase) -> Tensor:
        """The action (N, A); raises `InputError` for a wrong shape, or a NaN if that is not allowed."""
        action = tensordict[keys.ACTION]
        check_trailing_shape(keys.ACTION, action, self.num_envs, self.action_spec.shape[-1])
        action = action.detach().cpu()
        if self.on_bad_action == "hold":
            bad = ~torch.isfinite(action).all(dim=-1)
            return action.masked_fill(bad.unsqueeze(-1), 0.0)
        check_finite(keys.ACTION, action)
        return action

    def _see(self, target: Tensor) -> None:
        """Add ``target`` (N, D) float32 to the history, and count a step."""
        self._steps += 1
        self._trace = torch.cat([self._trace[:, 1:], target.unsqueeze(1)], dim=1)
        if self._sensing is not None:
            self._sensed = self._sensing.see(self._steps, self._trace[:, -2], self._trace[:, -1])
            self._held_trace = torch.cat([self._held_trace[:, 1:], self._sensed.held.unsqueeze(1)], dim=1)

    def _start_sensing(self, sensing: Sensing, rows: Tensor, episodes: Tensor, place: Tensor) -> None:
        """Give ``rows`` (M,) the first measurements of ``episodes`` (M,), whose targets are at ``place`` (M, D)."""
        first = sensing.start(rows, episodes, place, split=self.split, seed=self.seed)
        self._held_trace[rows] = first.held.unsqueeze(1)
        self._sensed = Sensed(*(old.index_copy(0, rows, new) for old, new in zip(self._sensed, first, strict=True)))

    @property
    def _is_over(self) -> Tensor:
        """Whether an episode has reached its last step, ``(N, 1)`` bool."""
        return (self._steps >= self.max_steps).unsqueeze(-1)

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Like TorchRL's, without its checks of every entry, which cost more than the step's own arithmetic."""
        if tensordict.device != self.device:
            tensordict = tensordict.to(self.device)
        after = self._step(tensordict)
        tensordict.set("next", after)
        entries = dict(tensordict.items()) | dict(after.items())
        del entries["next"], entries["reward"]
        done = entries["done"]
        if done.any():
            entries |= dict(self._reset(TensorDict({"_reset": done}, batch_size=self.batch_size)).items())
        return tensordict, TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _observe(self) -> dict[str, Tensor]:
        """The present observation, on the CPU; no entry shares memory with another."""
        robot, history = self._robot(), (self._trace if self._sensing is None else self._held_trace).clone()
        target = history[:, -1].clone()
        observation = [robot.state]
        if self.goal_in_observation:
            observation += [target] if self.static_target else [target, target - history[:, -2]]
        entries = {
            keys.TOOL_POS: robot.tool_pos.clone(),
            keys.TARGET_POS: target,
            keys.TARGET_HISTORY: history,
            keys.HISTORY_LENGTH: (self._steps + 1).clamp(max=self.history),
            keys.ROBOT_STATE: robot.state.clone(),
            keys.OBSERVATION: torch.cat(observation, dim=-1),
            keys.ACHIEVED_GOAL: robot.tool_pos.clone(),
            keys.DESIRED_GOAL: target.clone(),
            keys.STEP_COUNT: self._steps.unsqueeze(-1).clone(),
            keys.EPISODE: self._episode.clone(),
        }
        if robot.joint_pos is not None:
            entries[keys.JOINT_POS] = robot.joint_pos.clone()
        if robot.joint_vel is not None:
            entries[keys.JOINT_VEL] = robot.joint_vel.clone()
        entries |= {key: flag.unsqueeze(-1).clone() for key, flag in self._flags().items()}
        entries |= self._others()
        if self.static_target:
            entries[keys.GOAL] = target.clone()
        if self._sensing is not None:
            entries[keys.MEASURED_POS], entries[keys.MEASURED_TIME] = self._sensed.pos, self._sensed.time
            entries[keys.TRUE_TARGET_POS] = self._trace[:, -1].clone()
        return entries
