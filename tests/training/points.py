"""A task small enough to learn in seconds: points in a box that fly where they are pushed."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdyn_plan import keys
from torchdyn_plan.nets.policy import Actor, PolicyConfig
from torchdyn_plan.training import GoalTask

LENGTH, NEAR = 12, 0.1


def reached(place: Tensor, goal: Tensor) -> Tensor:
    return ((place - goal).norm(dim=-1, keepdim=True) < NEAR).float()


class PointEnv(EnvBase):
    """``num_envs`` points; episode i starts and aims as its number says."""

    def __init__(self, num_envs: int, seed: int = 0) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.num_points, self.seed, self.next_episode = num_envs, seed, 0
        shape = torch.Size((num_envs, 3))
        names = (keys.OBSERVATION, keys.ACHIEVED_GOAL, keys.DESIRED_GOAL)
        self.observation_spec = Composite({name: Unbounded(shape) for name in names}, shape=(num_envs,))
        self.action_spec = Bounded(-1.0, 1.0, shape=shape)
        self.reward_spec = Unbounded(torch.Size((num_envs, 1)))
        one = torch.Size((num_envs, 1))
        done = {name: Binary(shape=one, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done, shape=(num_envs,))

    def start_from(self, episode: int) -> None:
        self.next_episode = episode

    def _set_seed(self, seed: int | None) -> None:
        self.seed = seed or 0

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        draws = []
        for number in range(self.next_episode, self.next_episode + self.num_points):
            draws.append(torch.rand(2, 3, generator=torch.Generator().manual_seed(1000 * self.seed + number)))
        self.next_episode += self.num_points
        self.place, self.goal = torch.stack(draws).unbind(1)
        self.steps = 0
        return self._observe(done=False)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.place = (self.place + 0.15 * tensordict[keys.ACTION]).clamp(-0.2, 1.2)
        self.steps += 1
        result = self._observe(done=self.steps >= LENGTH)
        result["reward"] = reached(self.place, self.goal)
        return result

    def _observe(self, *, done: bool) -> TensorDict:
        flags = torch.full((self.num_points, 1), done)
        entries = {keys.OBSERVATION: self.place, keys.ACHIEVED_GOAL: self.place, keys.DESIRED_GOAL: self.goal}
        ends = {"done": flags, "truncated": flags.clone(), "terminated": torch.zeros_like(flags)}
        return TensorDict(entries | ends, batch_size=self.batch_size)


class PointTask(GoalTask):
    """Reach the goal and stay; scored by where the points are at the end."""

    policy_config = PolicyConfig(robot_state_size=3, tool_slice=(0, 3), action_size=3, hidden=32, layers=2)
    length = LENGTH

    def make_env(self, num_envs: int, *, seed: int) -> PointEnv:
        return PointEnv(num_envs, seed)

    def reward(self, transitions: TensorDictBase) -> Tensor:
        return reached(transitions["next", keys.ACHIEVED_GOAL], transitions[keys.DESIRED_GOAL])

    def score(self, actor: Actor) -> dict[str, float]:
        env = PointEnv(64, seed=77)
        state = env.reset()
        for _ in range(LENGTH):
            state[keys.ACTION] = actor(state[keys.OBSERVATION], state[keys.DESIRED_GOAL])
            state = env.step(state)["next"]
        return {"success": float(state["reward"].mean()), "steps": 0.0}

    def settings(self) -> dict[str, Any]:
        return {"task": "points"}
