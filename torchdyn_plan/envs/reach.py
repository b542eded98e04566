"""Dynamic FetchReach as a TorchRL environment: bring the Fetch gripper to a goal that moves."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdyn_plan import keys
from torchdyn_plan.checks import check_choice, check_finite, check_number, check_trailing_shape
from torchdyn_plan.envs.episodes import SPLITS
from torchdyn_plan.envs.fetch import ARM_JOINTS, FetchSimulation
from torchdyn_plan.envs.goal_motion import MOTIONS, GoalStarts, draw_goals, goal_places

MAX_STEPS = 50
"""Control steps of an episode: two seconds."""
THRESHOLD = 0.01
"""A gripper within this distance of its goal has reached it [m]."""
STATE_SIZE = 10
"""Entries of the robot state, which is FetchReach's observation; the gripper's place comes first."""


def is_at(tool_pos: Tensor, goal: Tensor, *, threshold: float = THRESHOLD) -> Tensor:
    """Whether a gripper at ``tool_pos`` (*B, 3) is within ``threshold`` of ``goal`` (*B, 3) [m]: ``(*B,)`` bool."""
    return (goal - tool_pos).norm(dim=-1) <= threshold


def reach_reward(tool_pos: Tensor, goal: Tensor, *, threshold: float = THRESHOLD) -> Tensor:
    """0 at the goal and -1 elsewhere, float32 ``(*B, 1)``: what both the step and hindsight give."""
    return is_at(tool_pos, goal, threshold=threshold).float().unsqueeze(-1) - 1.0


class DynamicReachEnv(EnvBase):
    """N independent episodes of reaching a moving goal, ``batch_size [num_envs]``, on the CPU; as in DHER.

    The order of a step is DHER's (Fang et al., ICLR 2019): first the goal moves by ``velocity``, but not while the
    gripper is at it; then the action and the physics; then reward and observation. The reward is 0 at the goal and -1
    elsewhere. An episode is never `terminated`, and `truncated` after ``max_steps``; it is a success if the gripper is
    at the goal after *any* step, which ``reached`` tells. Keys are those of `torchdyn_plan.keys`; an action is a pull
    along x, y and z, and a fourth entry for the fingers, which stay shut. Episode i starts as a pure function of
    (split, seed, i), whatever ``num_envs`` and ``num_threads``.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        velocity: float = 0.011,
        motion: str = "straight",
        static: bool = False,
        threshold: float = THRESHOLD,
        goal_range: float | None = None,
        seed: int = 0,
        split: str = "train",
        history: int = 8,
        max_steps: int = MAX_STEPS,
        num_threads: int = 0,
    ) -> None:
        """Build the batch.

        Args:
            num_envs: number of episodes that run side by side.
            velocity: how far the goal moves in a control step [m].
            motion: ``straight`` along +x, ``circle``, or ``random``: straight in a level direction of the episode's.
            static: FetchReach's own task: the goal rests, at any height, and `goal` says where.
            threshold: distance from the goal that counts as being there [m].
            goal_range: goals on lines start within this of the gripper along each axis [m]; 0.1 as in DHER, and 0.15
                as in FetchReach for ``static``.
            seed: which series of episodes.
            split: ``train``, ``dev`` or ``test``: series that never share an episode.
            history: length H of `target_history`, in control steps.
            max_steps: control steps after which an episode is truncated.
            num_threads: native threads of the simulation, 0 for all cores.

        Raises:
            InputError: a number is negative, NaN or of the wrong kind, the split or the motion is unknown, or
                gymnasium-robotics, which has the model, is not installed.
        """
        for name, value, minimum in (("num_envs", num_envs, 1), ("history", history, 2), ("max_steps", max_steps, 1)):
            check_number(name, value, minimum=minimum, integer=True)
        check_number("velocity", velocity, minimum=0.0, maximum=1.0)
        check_number("threshold", threshold, minimum=1e-6)
        check_number("seed", seed, minimum=0, integer=True)
        check_choice("split", split, SPLITS)
        check_choice("motion", motion, MOTIONS)
        goal_range = (0.15 if static else 0.1) if goal_range is None else goal_range
        check_number("goal_range", goal_range, minimum=0.0)
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.velocity, self.motion, self.static = 0.0 if static else velocity, motion, static
        self.threshold, self.goal_range = threshold, goal_range
        self.seed, self.split, self.max_steps, self.history = seed, split, max_steps, history
        self.simulation = FetchSimulation(num_envs, num_threads=num_threads)
        self._next_episode = 0
        self._episode = torch.zeros(num_envs, dtype=torch.int64)
        self._steps = torch.zeros(num_envs, dtype=torch.int64)
        self._moves = torch.zeros(num_envs, dtype=torch.int64)
        self._reached = torch.zeros(num_envs, dtype=torch.bool)
        empty = torch.zeros(num_envs, dtype=torch.float64)
        self._starts = GoalStarts(empty.unsqueeze(-1).repeat(1, 3), empty)
        self._goal = self._starts.place
        self._trace = torch.zeros(num_envs, history, 3)
        self._make_specs(num_envs, history)

    def _make_specs(self, n: int, history: int) -> None:
        joints = len(ARM_JOINTS)
        vectors = {
            keys.JOINT_POS: (joints,), keys.JOINT_VEL: (joints,), keys.TOOL_POS: (3,), keys.TARGET_POS: (3,),
            keys.TARGET_HISTORY: (history, 3), keys.ROBOT_STATE: (STATE_SIZE,), keys.OBSERVATION: (STATE_SIZE,),
            keys.ACHIEVED_GOAL: (3,), keys.DESIRED_GOAL: (3,),
        }  # fmt: skip
        if self.static:
            vectors[keys.GOAL] = (3,)
        one = torch.Size((n, 1))
        specs: dict[str, Any] = {key: Unbounded(torch.Size((n, *shape))) for key, shape in vectors.items()}
        for key in (keys.HISTORY_LENGTH, keys.STEP_COUNT, keys.EPISODE):
            specs[key] = Unbounded(self.batch_size, dtype=torch.int64)
        specs[keys.REACHED] = Binary(shape=one, dtype=torch.bool)
        self.observation_spec = Composite(specs, shape=(n,))
        self.action_spec = Bounded(-1.0, 1.0, shape=torch.Size((n, 4)))
        self.reward_spec = Unbounded(one)
        done = {key: Binary(shape=one, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done, shape=(n,))

    def start_from(self, episode: int) -> None:
        """Let the next reset take episode number ``episode``, and later ones the numbers after it."""
        check_number("episode", episode, minimum=0, integer=True)
        self._next_episode = episode

    @property
    def next_episode(self) -> int:
        """Number of the episode that the next reset takes."""
        return self._next_episode

    def _set_seed(self, seed: int | None) -> None:
        """Start the series ``seed`` at its first episode."""
        self.seed, self._next_episode = seed or 0, 0

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = torch.arange(self.num_envs) if mask is None else mask.reshape(-1).nonzero().squeeze(-1)
        if len(rows):
            episodes = torch.arange(self._next_episode, self._next_episode + len(rows))
            self._next_episode += len(rows)
            self.simulation.reset(rows)
            starts = draw_goals(
                episodes, self.simulation.start.tool_pos, motion=self.motion, goal_range=self.goal_range,
                split=self.split, seed=self.seed, level=not self.static,
            )  # fmt: skip
            for old, new in zip(self._starts, starts, strict=True):
                old[rows] = new
            self._episode[rows] = episodes
            self._steps[rows] = self._moves[rows] = 0
            self._goal = self._places()
            # Copies: what an earlier step returned shares the old ones.
            self._trace, self._reached = self._trace.clone(), self._reached.clone()
            self._reached[rows] = False
            self._trace[rows] = self._goal[rows].float().unsqueeze(1)
        result = self._observe()
        for key in ("done", "terminated", "truncated"):
            result[key] = torch.zeros(self.num_envs, 1, dtype=torch.bool)
        return result

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict[keys.ACTION]
        check_trailing_shape(keys.ACTION, action, self.num_envs, 4)
        check_finite(keys.ACTION, action)
        self._moves += ~is_at(self.simulation.tool_pos, self._goal, threshold=self.threshold)
        self._goal = self._places()
        self.simulation.step(action)
        self._steps += 1
        self._trace = torch.cat([self._trace[:, 1:], self._goal.float().unsqueeze(1)], dim=1)
        tool_pos = self.simulation.tool_pos
        self._reached = self._reached | is_at(tool_pos, self._goal, threshold=self.threshold)
        result = self._observe()
        result["reward"] = reach_reward(tool_pos, self._goal, threshold=self.threshold)
        truncated = (self._steps >= self.max_steps).unsqueeze(-1)
        result["terminated"] = torch.zeros_like(truncated)
        result["truncated"], result["done"] = truncated, truncated.clone()
        return result

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """As TorchRL's, without its checks of every entry."""
        after = self._step(tensordict)
        tensordict.set("next", after)
        entries = dict(tensordict.items()) | dict(after.items())
        del entries["next"], entries["reward"]
        done = entries["done"]
        if done.any():
            entries |= dict(self._reset(TensorDict({"_reset": done}, batch_size=self.batch_size)).items())
        return tensordict, TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _places(self) -> Tensor:
        return goal_places(self._starts, self._moves, motion=self.motion, velocity=self.velocity)

    def _observe(self) -> TensorDict:
        state = self.simulation.robot_state.float()
        tool, target = state[:, :3], self._trace[:, -1]
        entries = {
            keys.JOINT_POS: self.simulation.joint_pos.float(), keys.JOINT_VEL: self.simulation.joint_vel.float(),
            keys.TOOL_POS: tool, keys.TARGET_POS: target, keys.TARGET_HISTORY: self._trace,
            keys.HISTORY_LENGTH: self._steps.clamp(max=self.history), keys.ROBOT_STATE: state, keys.OBSERVATION: state,
            keys.ACHIEVED_GOAL: tool, keys.DESIRED_GOAL: target, keys.STEP_COUNT: self._steps.clone(),
            keys.EPISODE: self._episode.clone(), keys.REACHED: self._reached.unsqueeze(-1),
        }  # fmt: skip
        if self.static:
            entries[keys.GOAL] = target
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    @property
    def num_envs(self) -> int:
        """Number of episodes that run side by side."""
        return self.batch_size[0]
