"""Policy training with episodes run by workers of a Ray cluster."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase

from torchdyn_plan.errors import InputError
from torchdyn_plan.training.ddpg import DDPG
from torchdyn_plan.training.goal_task import DDPGRecipe, GoalTask


def on_cluster(kind: type[DDPG]) -> type[Any]:
    """``kind``, which is `DDPG` or a subclass, with its episodes run by workers, see `ClusterDDPG`."""
    return ClusterDDPG if kind is DDPG else type(f"Cluster{kind.__name__}", (ClusterDDPG, kind), {})


class ClusterDDPG(DDPG):
    """`DDPG` whose environments are spread evenly over Ray workers; each worker has its own series of episodes.

    A round waits for all workers, and the next one starts with the updated policy. Workers have their own random
    states, which are not in the checkpoint: a resumed training continues, but not bit for bit.
    """

    def __init__(
        self,
        task: GoalTask,
        recipe: DDPGRecipe,
        *,
        workers: int,
        device: str = "cpu",
        cluster: dict[str, Any] | None = None,
    ) -> None:
        """Networks and replay here, collection there.

        Args:
            task: see `DDPG`; workers import it, so it must be importable there.
            recipe: see `DDPG`.
            workers: number of Ray workers.
            device: where networks learn.
            cluster: arguments of `ray.init`; a cluster of ``workers`` CPUs on this machine by default.

        Raises:
            InputError: the environments cannot be spread evenly.
        """
        if workers < 1 or recipe.num_envs % workers:
            raise InputError(f"workers must divide num_envs {recipe.num_envs} evenly, got {workers}")
        if find_spec("ray") is None:
            raise InputError("workers need Ray: pip install 'torchdyn-plan[ray]'")
        self.workers = workers
        self.cluster = cluster or {"num_cpus": workers, "include_dashboard": False, "log_to_driver": False}
        super().__init__(task, recipe, device=device)

    def make_collector(self, policy: TensorDictModuleBase) -> BaseCollector:
        """A collector on every worker."""
        share = self.recipe.num_envs // self.workers
        makers = [
            partial(_make_env, self.task, share, 1 + self.recipe.seed * self.workers + worker)
            for worker in range(self.workers)
        ]
        return RayCollector(
            makers,
            policy,
            frames_per_batch=self.frames,
            total_frames=self.recipe.iterations * self.frames,
            sync=True,
            update_after_each_batch=True,
            ray_init_config=self.cluster,
            remote_configs={"num_cpus": 1, "num_gpus": 0},
            init_random_frames=self.recipe.warmup * self.frames,
        )

    def restart_collection(self, episode: int) -> None:
        """Nothing to do: workers restart their series."""


def _make_env(task: GoalTask, num_envs: int, seed: int) -> EnvBase:
    torch.set_num_threads(1)
    return task.make_env(num_envs, seed=seed)
