"""Whether a planner gives the same results in every kind of loop in TorchRL and PyTorch.

    python benchmarks/loops.py --out benchmarks/results/loops.json

Every loop plays the same episodes, half of them in each of two parallel environments, or in two environments of one
process. ``same`` is the share of episodes with the same outcome and number of plans as in the plain loop. Batches of
another size round matrix products differently, and a compiled planner fuses operations, so a few episodes may differ;
the test is that all but a few in a hundred, and the means, are equal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
import tyro
from study import Output, Row, Study, each, measuring
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ParallelEnv, RewardSum, SerialEnv, TransformedEnv

from torchdyn_plan import keys
from torchdyn_plan.tasks import DEFAULT, Task, load_task

Planner = Callable[[TensorDictBase], TensorDictBase]
"""From what is seen to what is done."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Output):
    """Play the same episodes in every loop."""

    task: str = DEFAULT
    """Whose planners and environment."""
    planners: tuple[str, ...] = ("pursuit", "corner", "wait_and_drop")
    """Planners for the moving target."""
    statics: tuple[str, ...] = ("ik",)
    """Their static planners."""
    episodes: int = 64
    """Episodes in each loop, an even number."""
    steps: int | None = None
    """Control steps that are played; an episode's length for None."""
    split: str = "dev"
    """Series of episodes."""
    seed: int = 0
    """Which series."""
    loops: tuple[str, ...] = ()
    """Names of the loops; all of them for none."""


@dataclass(frozen=True)
class World:
    """Episodes of a task for a loop."""

    task: Task
    arguments: Arguments

    @property
    def half(self) -> int:
        """Episodes in an environment."""
        return self.arguments.episodes // 2

    @property
    def steps(self) -> int:
        """Control steps that are played."""
        return self.arguments.steps or self.task.max_steps

    def make(self, worker: int) -> EnvBase:
        """The environment of ``worker``, with its half of the episodes."""
        about: dict[str, Any] = {"seed": self.arguments.seed, "split": self.arguments.split, "num_threads": 1}
        env: Any = self.task.make_env(self.task.default_settings(), num_envs=self.half, **about)
        env.start_from(worker * self.half)
        return env

    def both(self, kind: Callable[..., EnvBase], planner: Any, **settings: Any) -> EnvBase:
        """Both environments in a ``kind`` of environment, which carries the planner's memory."""
        env = kind(2, [partial(self.make, worker) for worker in range(2)], **settings)
        return TransformedEnv(env, planner.make_tensordict_primer())

    def alone(self, play: Callable[[EnvBase], TensorDictBase]) -> TensorDictBase:
        """One environment after the other: ``(2, N, T)``."""
        return torch.stack([play(self.make(worker)) for worker in range(2)])

    def rolled(self, env: EnvBase, planner: Planner) -> TensorDictBase:
        """TorchRL's rollout."""
        try:
            return env.rollout(self.steps, planner, break_when_any_done=False)
        finally:
            env.close()

    def collected(self, env: EnvBase, planner: Any) -> TensorDictBase:
        """One batch of TorchRL's collector."""
        frames = env.batch_size.numel() * self.steps
        how: dict[str, Any] = {"frames_per_batch": frames, "total_frames": frames}
        collector = Collector(env, planner, auto_register_policy_transforms=False, **how)
        try:
            return next(iter(collector)).clone()
        finally:
            collector.shutdown()

    def by_hand(self, env: EnvBase, planner: Planner) -> TensorDictBase:
        """Step after step."""
        rows, state = [], env.reset()
        for _ in range(self.steps):
            stepped, state = env.step_and_maybe_reset(planner(state))
            rows.append(stepped)
        return torch.stack(rows, dim=-1)


def compiled(planner: Any) -> Planner:
    """The planner as one graph."""
    torch._dynamo.reset()
    return torch.compile(planner, fullgraph=True)


FORK = {"mp_start_method": "fork"}
LOOPS: dict[str, Callable[[World, Any], TensorDictBase]] = {
    "step_and_maybe_reset": lambda world, planner: world.alone(lambda env: world.by_hand(env, planner)),
    "rollout": lambda world, planner: world.alone(lambda env: world.rolled(env, planner)),
    "rollout of TransformedEnv": lambda world, planner: world.alone(
        lambda env: world.rolled(TransformedEnv(env, RewardSum()), planner)
    ),
    "rollout of SerialEnv": lambda world, planner: world.rolled(world.both(SerialEnv, planner), planner),
    "rollout of ParallelEnv": lambda world, planner: world.rolled(world.both(ParallelEnv, planner, **FORK), planner),
    "Collector": lambda world, planner: world.alone(lambda env: world.collected(env, planner)),
    "Collector of SerialEnv": lambda world, planner: world.collected(world.both(SerialEnv, planner), planner),
    "Collector of ParallelEnv": lambda world, planner: world.collected(
        world.both(ParallelEnv, planner, **FORK), planner
    ),
    "torch.compile(planner)": lambda world, planner: world.alone(lambda env: world.rolled(env, compiled(planner))),
}
"""Loops by name; each plays the two halves of the episodes, ``(2, N, T)``, and more after them. The first is plain."""


def first_episodes(data: TensorDictBase, success: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Success of each row's first episode, and the plans that were made in it: ``(E,)`` each."""
    data = data.flatten(0, 1)
    after = data["next"]
    done = after["done"].squeeze(-1)
    played = torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], dim=1).cumsum(dim=1) == 0
    memory = data.get(keys.PLAN, None)
    plans = memory.get("replanned") if memory is not None and "replanned" in memory else torch.zeros_like(done)
    return (after[success].squeeze(-1) & played).any(-1), (plans & played).sum(-1)


def main(arguments: Arguments) -> None:
    """Play, compare with the plain loop, save and print."""
    task = load_task(arguments.task)
    world, study = World(task, arguments), Study(arguments, scene=task.digest())
    names = ["step_and_maybe_reset", *(arguments.loops or LOOPS)]
    env: Any = world.make(0)
    with measuring():
        for static in arguments.statics:
            for name in arguments.planners:
                planner = task.planner(name, static)
                for loop in each(dict.fromkeys(names), f"{name}, {static}"):

                    def measure(loop: str = loop, planner: Any = planner) -> Row:
                        success, plans = first_episodes(LOOPS[loop](world, planner), env.flags[0])
                        figures = {"success": float(success.double().mean()), "plans": float(plans.double().mean())}
                        return figures | {"list": [success.int().tolist(), plans.tolist()]}

                    about = {"planner": name, "static": static, "loop": loop, "episodes": arguments.episodes}
                    row = study.row(about, measure)
                    if loop == names[0]:
                        plain = row
                    pairs = zip(zip(*row["list"], strict=True), zip(*plain["list"], strict=True), strict=True)
                    row["same"] = sum(one == other for one, other in pairs) / arguments.episodes
                    study.save()


if __name__ == "__main__":
    main(tyro.cli(Arguments))
