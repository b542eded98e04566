"""Policies trained with hindsight replay, ours and Stable-Baselines3's: success on the same resting balls.

python benchmarks/policy_peers.py --minutes 5 --out benchmarks/results/policy_peers.json   # needs the extra `peer`

The peers are SAC and TQC with the settings that RL Baselines3 Zoo tuned for FetchReach, given our features of state and
goal, our goals and our matrix products. Every run has one thread. Rows are runs; a killed study continues.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
import torch
import tyro
from scipy.stats import trim_mean
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from study import Output, Row, Study, told
from torch import Tensor, nn

from torchdyn_plan import keys
from torchdyn_plan.envs.gym_env import GoalGymEnv
from torchdyn_plan.nets.policy import GoalFeatures, PolicyConfig
from torchdyn_plan.tasks.trapper.policy import TrapperGoalTask
from torchdyn_plan.threads import quick_products
from torchdyn_plan.training.algorithms import learner_type, recipe_for
from torchdyn_plan.training.goal_task import DDPGRecipe

ZOO: dict[str, Any] = {
    "buffer_size": 1_000_000,
    "ent_coef": "auto",
    "batch_size": 256,
    "gamma": 0.95,
    "learning_rate": 1e-3,
    "learning_starts": 1000,
    "replay_buffer_class": HerReplayBuffer,
    "replay_buffer_kwargs": {"goal_selection_strategy": "future", "n_sampled_goal": 4},
}
"""RL Baselines3 Zoo, hyperparams/sac.yml and tqc.yml, FetchReach; its normalised inputs are our features."""
PEERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "sac": (stable_baselines3.SAC, {"net_arch": [64, 64]}),
    "tqc": (sb3_contrib.TQC, {"net_arch": [64, 64], "n_critics": 1}),
    "tqc-wide": (sb3_contrib.TQC, {"net_arch": [256, 256, 256], "n_critics": 2}),
}
"""Class and networks of each peer; tqc-wide has our widths and the two critics of the Zoo's other Fetch tasks."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Train each for the same time, one after the other."""

    learners: tuple[str, ...] = ("averaged", "ddpg", "sac", "tqc", "tqc-wide")
    """Our algorithms, and peers, in the order in which they run."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """One run of each learner for each."""
    minutes: float = 5.0
    """Processor time of a run, scoring left out: on a quiet machine its wall time."""
    target: float = 0.95
    """Success at which the clock is read."""
    score_seconds: float = 10.0
    """Processor time between two scores."""
    draws: int = 2000
    """Of the bootstrap."""


class Clock:
    """Time of the training alone."""

    def __init__(self, task: TrapperGoalTask, arguments: Arguments) -> None:
        self.task, self.arguments = task, arguments
        self.points: list[Row] = []
        self.scored = 0.0
        self.spent, self.since = np.zeros(2), self._now()

    @staticmethod
    def _now() -> np.ndarray[Any, Any]:
        return np.array([time.process_time(), time.perf_counter()])

    @property
    def seconds(self) -> tuple[float, float]:
        """Processor and wall time so far."""
        processor, wall = self.spent + self._now() - self.since
        return float(processor), float(wall)

    @property
    def is_over(self) -> bool:
        """Whether the time is used up."""
        return self.seconds[0] > 60.0 * self.arguments.minutes

    def tick(self, actor: Any, transitions: int, updates: int, *, last: bool = False) -> None:
        """Score ``actor``, a function of state and goal, if it is time to, the clock standing still meanwhile."""
        processor, wall = self.seconds
        if processor - self.scored < self.arguments.score_seconds and not last:
            return
        self.spent = np.array([processor, wall])
        with torch.no_grad():
            score = self.task.score(actor)
        about = {"seconds": processor, "wall_seconds": wall, "transitions": transitions, "updates": updates}
        self.points.append({name: round(value, 4) for name, value in (about | score).items()})
        self.scored, self.since = processor, self._now()

    def summary(self) -> Row:
        """The curve, rates, and the time to the target."""
        last = self.points[-1]
        reached = [point["seconds"] for point in self.points if point["success"] >= self.arguments.target]
        return {
            "transitions_per_second": round(last["transitions"] / last["seconds"], 1),
            "updates_per_second": round(last["updates"] / last["seconds"], 1),
            "best_success": max(point["success"] for point in self.points),
            "seconds_to_target": reached[0] if reached else None,
            "list": self.points,
        }


class PeerFeatures(BaseFeaturesExtractor):
    """Our features of state and goal, for the peer's networks."""

    def __init__(self, space: Any, statistics: dict[str, Tensor]) -> None:
        features = GoalFeatures(PolicyConfig())
        features.load_state_dict(statistics)
        super().__init__(space, features.size)
        self.features = features

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Of the desired goal's pose only the place counts."""
        return self.features(observations[keys.OBSERVATION], observations[keys.DESIRED_GOAL][..., :3])


class PeerActor(nn.Module):
    """The peer's policy as ours is called."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.actor = model.policy.actor

    def forward(self, state: Tensor, goal: Tensor) -> Tensor:
        """Actions (*B, 6)."""
        pose = nn.functional.pad(goal, (0, 9))
        return self.actor(
            {keys.OBSERVATION: state, keys.DESIRED_GOAL: pose, keys.ACHIEVED_GOAL: pose}, deterministic=True
        )


class Scoring(BaseCallback):
    """Lets the clock tick after each step of the peer."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock = clock

    def _on_step(self) -> bool:
        self.clock.tick(PeerActor(self.model), self.num_timesteps, self.model._n_updates)
        return not self.clock.is_over


def train_ours(name: str, seed: int, task: TrapperGoalTask, arguments: Arguments) -> Row:
    """The loop of ``torchdyn-plan train policy --algorithm NAME``, by its own recipe."""
    recipe = recipe_for(name, DDPGRecipe(seed=seed))
    clock = Clock(task, arguments)
    learner = learner_type(name)(task, recipe)
    while not clock.is_over and learner.iteration < recipe.iterations:
        learner.iterate()
        updates = recipe.updates * max(0, learner.iteration - recipe.warmup)
        last = clock.is_over or learner.iteration == recipe.iterations
        clock.tick(learner.learned, learner.iteration * learner.frames, updates, last=last)
    learner.close()
    return clock.summary()


def train_peer(name: str, seed: int, task: TrapperGoalTask, arguments: Arguments) -> Row:
    """Stable-Baselines3 by the Zoo's settings: one environment, an update for each of its steps."""
    kind, networks = PEERS[name]
    clock = Clock(task, arguments)
    form = "torchdyn_plan.envs.trapper.gym_forms:STATIC"
    make = partial(GoalGymEnv, form, seed=1000 + seed, period=task.period, max_steps=task.length, num_threads=1)
    features = {"features_extractor_class": PeerFeatures, "features_extractor_kwargs": {"statistics": statistics(task)}}
    model = kind(
        "MultiInputPolicy", DummyVecEnv([make]), policy_kwargs=networks | features, seed=seed, device="cpu", **ZOO
    )
    with quick_products():
        model.learn(10**9, callback=Scoring(clock))
    return clock.summary()


def statistics(task: TrapperGoalTask) -> dict[str, Tensor]:
    """What random actions show of states and goals, as our own learners standardise by."""
    sample = task.make_env(32, seed=100).rollout(task.length, break_when_any_done=False).reshape(-1)
    features = GoalFeatures(PolicyConfig())
    features.set_statistics(sample[keys.OBSERVATION], sample[keys.DESIRED_GOAL])
    return features.state_dict()


def values_at(points: Sequence[Row], over: str, places: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Success at ``places`` (P,) along ``over``: that of the last score before, 0 before the first one."""
    known = np.array([0.0, *(point[over] for point in points)])
    success = np.array([0.0, *(point["success"] for point in points)])
    return success[np.searchsorted(known, places, side="right") - 1]


def middle_and_interval(values: np.ndarray[Any, Any], draws: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Interquartile mean over runs of ``values`` (R, P), ``(P,)``, and its 95 % bootstrap interval, ``(2, P)``."""
    chosen = np.random.default_rng(0).integers(len(values), size=(draws, len(values)))
    means = trim_mean(values[chosen], 0.25, axis=1)
    return trim_mean(values, 0.25, axis=0), np.quantile(means, (0.025, 0.975), axis=0)


def curves(rows: list[Row], over: str, places: np.ndarray[Any, Any], draws: int) -> dict[str, list[list[float]]]:
    """Of each learner: rows of place, interquartile mean of success, and its interval."""
    found = {}
    for what in dict.fromkeys(row["what"] for row in rows):
        runs = np.stack([values_at(row["list"], over, places) for row in rows if row["what"] == what])
        middle, interval = middle_and_interval(runs, draws)
        found[what] = np.column_stack([places, middle, *interval]).round(4).tolist()
    return found


def plot(rows: list[Row], arguments: Arguments) -> None:
    """Success against time and against transitions, beside the file of figures."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(8.4, 3.6), layout="constrained", sharey=True)
    for axes, over, unit, label in (
        (panels[0], "seconds", 60.0, "training time, one thread [min]"),
        (panels[1], "transitions", 1000.0, "transitions [thousand]"),
    ):
        longest = max(row["list"][-1][over] for row in rows)
        first = min(row["list"][0][over] for row in rows)
        places = np.linspace(0, longest, 200) if over == "seconds" else np.geomspace(first, longest, 200)
        for what, points in curves(rows, over, places, arguments.draws).items():
            runs = [row for row in rows if row["what"] == what]
            ends = max(row["list"][-1][over] for row in runs)
            shown = np.array([point for point in points if point[0] <= ends])
            label_of_line = f"{what} ({len(runs)} seed{'s' * (len(runs) > 1)})"
            axes.plot(shown[:, 0] / unit, shown[:, 1], label=label_of_line)
            axes.fill_between(shown[:, 0] / unit, shown[:, 2], shown[:, 3], alpha=0.2)
        axes.axhline(arguments.target, color="grey", linewidth=0.8, linestyle="--")
        axes.set(xlabel=label, ylim=(-0.03, 1.02))
    panels[1].set_xscale("log")
    panels[0].set_ylabel("resting balls within reach trapped")
    panels[1].legend(loc="upper left", fontsize="small")
    figure.savefig(arguments.out.with_suffix(".png"), dpi=150)


def main(arguments: Arguments) -> None:
    """Train, save and print; a plot is put beside the file."""
    torch.set_num_threads(1)
    task = TrapperGoalTask(num_threads=1)
    study = Study(arguments, scene=task.scene.digest())
    peers = {"stable-baselines3": stable_baselines3.__version__, "sb3-contrib": sb3_contrib.__version__}
    for seed in arguments.seeds:
        for name in arguments.learners:
            train = train_peer if name in PEERS else train_ours
            about = {"what": name, "seed": seed, "minutes": arguments.minutes}
            study.row(about, partial(train, name, seed, task, arguments))
            study.save(peers=peers)
    rows = [row for row in study.rows if row["minutes"] == arguments.minutes]
    places = np.arange(0.0, 60.0 * arguments.minutes + 1.0, 15.0)
    found = curves(rows, "seconds", places, arguments.draws)
    study.save(peers=peers, interquartile_means=found)
    for name, points in found.items():
        print(told({"what": name, "success at the end": points[-1][1], "interval": points[-1][2:]}))
    if arguments.out is not None:
        plot(rows, arguments)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
