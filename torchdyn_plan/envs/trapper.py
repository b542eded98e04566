"""Trapper as a TorchRL environment: drop a box over a rolling ball."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdyn_plan import keys
from torchdyn_plan.checks import check_choice, check_finite, check_number, check_trailing_shape
from torchdyn_plan.envs.episodes import SPLITS, draw_starts
from torchdyn_plan.envs.rewards import GoalReward, goal_reward
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.envs.simulation import TrapperSimulation
from torchdyn_plan.envs.trapping import is_covered, is_pocketed
from torchdyn_plan.kinematics.arm import Arm

HOLD_STEPS = 10
"""Control steps for which a ball must stay covered to count as trapped."""
MAX_STEPS = 500
"""Control steps of an episode: two seconds."""

ROWS = 64
"""Kinematics are computed for a multiple of so many arms."""


class TrapperEnv(EnvBase):
    """N independent Trapper episodes, ``batch_size [num_envs]``, on the CPU; keys as in `torchdyn_plan.keys`.

    An episode is `terminated` when the ball is trapped (covered, and kept for `HOLD_STEPS` steps) or pocketed, and
    `truncated` after ``max_steps`` control steps. The reward is 1 in the step that traps the ball and 0 elsewhere.
    With ``static`` it is the paper's `goal_reward`, and the step that traps the ball brings all that the box would earn
    there until the end, so that an episode which ends early loses nothing.
    Episode i starts as a pure function of (split, seed, i): environments take the next index when they reset, so that
    the same actions give bit-identical episodes whatever ``num_envs`` and ``num_threads``.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        velocity: float = 3.0,
        friction: float = 0.0,
        static: bool = False,
        seed: int = 0,
        split: str = "train",
        scene: TrapperScene | None = None,
        history: int = 24,
        max_steps: int = MAX_STEPS,
        weights: GoalReward | None = None,
        num_threads: int = 0,
    ) -> None:
        """Build the batch.

        Args:
            num_envs: number of episodes that run side by side.
            velocity: speed of the ball at the start [m/s].
            friction: friction loss on the ball's horizontal translation [N].
            static: the ball lies still, and `goal` is where it lies.
            seed: which series of episodes.
            split: ``train``, ``dev`` or ``test``: series that never share an episode.
            scene: geometry and physics; the calibrated scene by default.
            history: length H of `target_history`, in control steps.
            max_steps: control steps after which an episode is truncated.
            weights: of the terms of the reward with ``static``.
            num_threads: native threads of the simulation, 0 for all cores.

        Raises:
            InputError: a number is negative, NaN or of the wrong kind, or the split is unknown.
        """
        for name, value, minimum in (("num_envs", num_envs, 1), ("history", history, 2), ("max_steps", max_steps, 1)):
            check_number(name, value, minimum=minimum, integer=True)
        check_number("velocity", velocity, minimum=0.0, maximum=20.0)
        check_number("friction", friction, minimum=0.0)
        check_number("seed", seed, minimum=0, integer=True)
        check_choice("split", split, SPLITS)
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.scene, self.weights = scene or TrapperScene(), weights or GoalReward()
        self.velocity, self.friction, self.static = 0.0 if static else velocity, friction, static
        self.seed, self.split, self.max_steps, self.history = seed, split, max_steps, history
        self.simulation = TrapperSimulation(num_envs, self.scene, friction=friction, num_threads=num_threads)
        self._arm = Arm.ur5(tool_length=self.scene.tool_length)
        self._base = torch.tensor(self.scene.base_pos)
        self._next_episode = 0
        self._episode = torch.zeros(num_envs, dtype=torch.int64)
        self._steps = torch.zeros(num_envs, dtype=torch.int64)
        self._held = torch.zeros(num_envs, dtype=torch.int64)
        self._trace = torch.zeros(num_envs, history, 3)
        home = torch.tensor(self.scene.home, dtype=torch.float64)
        self._home_tool_pos = self._tool(home.expand(num_envs, -1))[0][0]
        self._tool_pos = self._home_tool_pos.repeat(num_envs, 1)
        self._make_specs(num_envs, history)

    def _make_specs(self, n: int, history: int) -> None:
        vectors = {
            keys.JOINT_POS: (6,), keys.JOINT_VEL: (6,), keys.TOOL_POS: (3,), keys.TARGET_POS: (3,),
            keys.TARGET_HISTORY: (history, 3), keys.ROBOT_STATE: (15,), keys.OBSERVATION: (15,),
            keys.ACHIEVED_GOAL: (3,), keys.DESIRED_GOAL: (3,),
        }  # fmt: skip
        if self.static:
            vectors[keys.GOAL] = (3,)
        one = torch.Size((n, 1))
        specs: dict[str, Any] = {key: Unbounded(torch.Size((n, *shape))) for key, shape in vectors.items()}
        for key in (keys.HISTORY_LENGTH, keys.STEP_COUNT, keys.EPISODE):
            specs[key] = Unbounded(self.batch_size, dtype=torch.int64)
        for key in (keys.TRAPPED, keys.POCKETED):
            specs[key] = Binary(shape=one, dtype=torch.bool)
        self.observation_spec = Composite(specs, shape=(n,))
        self.action_spec = Bounded(-1.0, 1.0, shape=torch.Size((n, 6)))
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
            place, speed = draw_starts(self.scene, episodes, velocity=self.velocity, split=self.split, seed=self.seed)
            self.simulation.reset(rows, place, speed)
            self._episode[rows] = episodes
            self._steps[rows] = self._held[rows] = 0
            # A copy: what an earlier step returned shares the old one.
            self._trace = self._trace.clone()
            self._trace[rows] = self.simulation.ball_pos[rows].float().unsqueeze(1)
            self._tool_pos = self._tool_pos.clone()
            self._tool_pos[rows] = self._home_tool_pos
        result = self._observe(torch.zeros(self.num_envs, dtype=torch.bool))
        for key in ("done", "terminated", "truncated"):
            result[key] = torch.zeros(self.num_envs, 1, dtype=torch.bool)
        return result

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict[keys.ACTION]
        check_trailing_shape(keys.ACTION, action, self.num_envs, 6)
        check_finite(keys.ACTION, action)
        self.simulation.step(action)
        self._steps += 1
        ball = self.simulation.ball_pos.float()
        self._trace = torch.cat([self._trace[:, 1:], ball.unsqueeze(1)], dim=1)
        self._tool_pos, rotation = self._tool(self.simulation.joint_pos)
        covered = is_covered(self.scene, self._tool_pos, rotation, ball)
        self._held = torch.where(covered, self._held + 1, 0)
        trapped = self._held >= HOLD_STEPS
        result = self._observe(trapped)
        terminated = result[keys.TRAPPED] | result[keys.POCKETED]
        truncated = (self._steps >= self.max_steps).unsqueeze(-1)
        result["reward"] = trapped.float().unsqueeze(-1)
        if self.static:
            reward = goal_reward(self.scene, self.weights, self._tool_pos, rotation, ball)
            left = (self.max_steps - self._steps + 1).clamp_min(1)
            result["reward"] = torch.where(trapped.unsqueeze(-1), reward * left.unsqueeze(-1), reward)
        result["terminated"], result["truncated"], result["done"] = terminated, truncated, terminated | truncated
        return result

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

    def _tool(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Place (N, 3) [m, world] and rotation (N, 3, 3) of the box mouth at joint angles (N, 6) [rad]."""
        # Matrix products treat the last few rows in another way, with another last bit: these are padding.
        padded = nn.functional.pad(joint_pos.float(), (0, 0, 0, -self.num_envs % ROWS))
        pose = self._arm(padded)[: self.num_envs]
        return pose[:, :3, 3] + self._base, pose[:, :3, :3]

    def _observe(self, trapped: Tensor) -> TensorDict:
        joint_pos, joint_vel = self.simulation.joint_pos.float(), self.simulation.joint_vel.float()
        tool, target = self._tool_pos, self._trace[:, -1]
        state = torch.cat([joint_pos, joint_vel, tool], dim=-1)
        entries = {
            keys.JOINT_POS: joint_pos, keys.JOINT_VEL: joint_vel, keys.TOOL_POS: tool, keys.TARGET_POS: target,
            keys.TARGET_HISTORY: self._trace, keys.HISTORY_LENGTH: self._steps.clamp(max=self.history),
            keys.ROBOT_STATE: state, keys.OBSERVATION: state, keys.ACHIEVED_GOAL: tool, keys.DESIRED_GOAL: target,
            keys.STEP_COUNT: self._steps.clone(), keys.EPISODE: self._episode.clone(),
            keys.TRAPPED: trapped.unsqueeze(-1), keys.POCKETED: is_pocketed(self.scene, target).unsqueeze(-1),
        }  # fmt: skip
        if self.static:
            entries[keys.GOAL] = target
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    @property
    def num_envs(self) -> int:
        """Number of episodes that run side by side."""
        return self.batch_size[0]
