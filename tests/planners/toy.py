"""A point robot that chases a point on a line: the smallest world in which a planner has all its keys."""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdyn_plan.nets import Arrival, ArrivalModel, Forecast, ForecastModel
from torchdyn_plan.planners import CallablePlanner, CornerSearch, DynamicPlanner, ReplanSchedule
from torchdyn_plan.planners.planner import observe

HISTORY, SPEED = 6, 0.01
NO_MEMORY = "ignore:the planner's memory is missing:RuntimeWarning"
"""For tests that show a planner rows in mid-episode and no memory, to plan at once."""
SCHEDULE = ReplanSchedule(first_step=3, window=12, shrink=0.9, minimum=5)


class Straight(ForecastModel):
    """Forecaster that goes on as in the last step; counts the rows that it saw."""

    def __init__(self, horizon=40):
        super().__init__()
        self.horizon, self.rows = horizon, []

    def path(self, history):
        ahead = torch.arange(1, self.horizon + 1, dtype=history.dtype, device=history.device)
        return history[..., -1:, :] + ahead[:, None] * (history[..., -1:, :] - history[..., -2:-1, :])

    def predict(self, history):
        self.rows.append(history.shape[0])
        return Forecast(self.path(history))


class StraightArrival(ArrivalModel):
    """Arrival of a robot that goes straight at `SPEED`; the state ends with the tool position."""

    def __init__(self):
        super().__init__()
        self.shapes = []

    def arrival(self, robot_state, goal, *, estimator="mode"):
        self.shapes.append(tuple(goal.shape))
        steps = torch.linalg.vector_norm(goal - robot_state[..., -3:], dim=-1) / SPEED
        return Arrival(steps, steps > 1000)


def go_straight():
    def action(robot_state, goal):
        return ((goal - robot_state[..., -3:]) / SPEED).clamp(-1, 1)

    return CallablePlanner(action)


def make_planner(**settings):
    settings = {"schedule": SCHEDULE, "search": CornerSearch(), **settings}
    return DynamicPlanner(go_straight(), Straight(), StraightArrival(), **settings)


def observation(batch=(), step=0, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    history = torch.rand(*batch, HISTORY, 3, generator=generator, dtype=dtype)
    tool = torch.rand(*batch, 3, generator=generator, dtype=dtype)
    entries = {
        "target_history": history,
        "target_pos": history[..., -1, :],
        "tool_pos": tool,
        "robot_state": tool,
        "step_count": torch.full(batch, step),
    }
    return TensorDict(entries, batch_size=batch)


def seen_by(planner, td):
    """What ``planner`` sees in ``td``."""
    return observe(td, planner.forecaster)


def assert_same(one, other):
    assert one.batch_size == other.batch_size
    for key in ("goal", "arrival_steps", "action", "step_count", *(("plan", k) for k in sorted(one["plan"].keys()))):
        assert torch.equal(one[key], other[key]), key


class ToyEnv(EnvBase):
    """Episode i starts as a function of i alone and ends when the robot meets the target, or after ``max_steps``."""

    def __init__(self, num_envs, max_steps=120, first_episode=0):
        super().__init__(device="cpu", batch_size=[num_envs])
        self.max_steps, self.next_episode = max_steps, first_episode
        self.tool = torch.zeros(num_envs, 3)
        self.trace = torch.zeros(num_envs, HISTORY, 3)
        self.velocity = torch.zeros(num_envs, 3)
        self.steps = torch.zeros(num_envs, dtype=torch.int64)
        self.episode = torch.zeros(num_envs, dtype=torch.int64)
        n, integer = num_envs, torch.int64
        self.observation_spec = Composite(
            robot_state=Unbounded((n, 3)),
            tool_pos=Unbounded((n, 3)),
            target_pos=Unbounded((n, 3)),
            target_history=Unbounded((n, HISTORY, 3)),
            step_count=Unbounded((n,), dtype=integer),
            episode=Unbounded((n,), dtype=integer),
            shape=(n,),
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(n, 3))
        self.reward_spec = Unbounded((n, 1))
        done = {key: Binary(shape=(n, 1), dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done, shape=(n,))

    def _set_seed(self, seed):
        self.next_episode = seed or 0

    def _reset(self, tensordict=None, **_):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = torch.arange(self.batch_size[0]) if mask is None else mask.reshape(-1).nonzero().squeeze(-1)
        for row in rows.tolist():
            generator = torch.Generator().manual_seed(self.next_episode)
            start, velocity, tool = torch.rand(3, 3, generator=generator) - 0.5
            self.episode[row], self.steps[row] = self.next_episode, 0
            self.tool[row], self.trace[row], self.velocity[row] = tool, start, 0.02 * velocity
            self.next_episode += 1
        no = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self.observe().update({"done": no, "terminated": no.clone(), "truncated": no.clone()})

    def _step(self, tensordict):
        self.tool = self.tool + SPEED * tensordict["action"]
        self.trace = torch.cat([self.trace[:, 1:], (self.trace[:, -1] + self.velocity).unsqueeze(1)], dim=1)
        self.steps += 1
        met = (self.tool - self.trace[:, -1]).norm(dim=-1, keepdim=True) < 0.02
        late = (self.steps >= self.max_steps).unsqueeze(-1)
        end = {"reward": met.float(), "terminated": met, "truncated": late, "done": met | late}
        return self.observe().update(end)

    def observe(self):
        entries = {
            "robot_state": self.tool.clone(),
            "tool_pos": self.tool.clone(),
            "target_pos": self.trace[:, -1].clone(),
            "target_history": self.trace.clone(),
            "step_count": self.steps.clone(),
            "episode": self.episode.clone(),
        }
        return TensorDict(entries, batch_size=self.batch_size)
