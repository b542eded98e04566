"""A task of a person's own, as small as one can be: a point pulls itself to a point that drifts away along x."""

import dataclasses

import torch

from torchdyn_plan import Settings, Task, Words, setting
from torchdyn_plan.envs.episodes import draw_uniform
from torchdyn_plan.envs.moving_target import MovingTargetEnv, RobotReading
from torchdyn_plan.planners import CallablePlanner, TargetPursuit

SPEED, NEAR, MAX_STEPS = 0.05, 0.06, 40


@dataclasses.dataclass(frozen=True, kw_only=True)
class DriftSettings(Settings):
    drift: float = setting(
        0.01, text="How far the point drifts", unit="m a step", minimum=0.0, maximum=1.0, sweep=(0, 0.02, 0.1)
    )


class DriftEnv(MovingTargetEnv):
    """Success is being near; a target may also be far, which ends nothing, and fall back."""

    flags = ("caught", "far")

    def __init__(self, num_envs=1, *, drift, num_threads=0, **settings):
        super().__init__(num_envs, state_size=3, action_size=3, max_steps=MAX_STEPS, history=4, **settings)
        self.drift = torch.tensor([drift, 0.0, 0.0])
        self.tool, self.target = torch.zeros(num_envs, 3), torch.zeros(num_envs, 3)

    def _start(self, rows, episodes):
        self.tool[rows] = 0.0
        self.target[rows] = draw_uniform(episodes, 3, split=self.split, seed=self.seed).float()
        return self.target[rows]

    def _advance(self, action):
        self.tool = self.tool + SPEED * action
        self.target = self.target + self.drift
        return self.target

    def _robot(self):
        return RobotReading(self.tool, self.tool)

    def _flags(self):
        away = (self.tool - self.target).norm(dim=-1)
        return {"caught": away < NEAR, "far": away > 1.5}

    def _terminated(self, observed):
        return torch.zeros_like(observed["caught"])


def pull(*, chunk=None, weights=None):
    return CallablePlanner(lambda state, goal: ((goal - state) / SPEED).clamp(-1.0, 1.0))


TASK = Task(
    name="drift",
    summary="A point catches another one.",
    settings=DriftSettings,
    words=Words(success="caught", steps="steps to catch", target="point"),
    max_steps=MAX_STEPS,
    control_step=0.1,
    make_env=lambda settings, **batch: DriftEnv(drift=settings.drift, **batch),
    digest=lambda: "drift-1",
    static_planners={"pull": pull},
    planners={"pursuit": lambda parts: TargetPursuit(parts.static, scene="drift-1")},
)
