"""The training on a local Ray cluster of two workers."""

import pytest
import torch

from tests.training.points import PointTask
from torchdyn_plan.errors import InputError
from torchdyn_plan.training.goal_task import DDPGRecipe

pytest.importorskip("ray")
from torchdyn_plan.training.averaged import AveragedDDPG
from torchdyn_plan.training.cluster import ClusterDDPG, on_cluster
from torchdyn_plan.training.ddpg import DDPG


def test_two_workers_learn_the_same_task(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    monkeypatch.setenv("PYTHONPATH", str(request.config.rootpath))
    recipe = DDPGRecipe(iterations=24, num_envs=16, updates=30, batch=128, capacity=20_000, warmup=2, gamma=0.9)
    ddpg = ClusterDDPG(PointTask(), recipe, workers=2)
    try:
        for _ in range(recipe.iterations):
            ddpg.iterate()
    finally:
        ddpg.close()
    stored = ddpg.replay.tensors()["observation"]
    assert len(stored) == 24 * 16 * PointTask.length
    starts = stored[:: PointTask.length][:16]
    assert len(torch.unique(starts, dim=0)) == 16, "two workers ran the same episodes"
    assert PointTask().score(ddpg.actor)["success"] > 0.9


def test_environments_are_spread_evenly() -> None:
    with pytest.raises(InputError, match="workers must divide num_envs 16 evenly, got 3"):
        ClusterDDPG(PointTask(), DDPGRecipe(num_envs=16), workers=3)


def test_every_way_to_learn_can_have_workers() -> None:
    assert on_cluster(DDPG) is ClusterDDPG
    averaged = on_cluster(AveragedDDPG)
    assert averaged.make_collector is ClusterDDPG.make_collector
    assert averaged.differentiate is AveragedDDPG.differentiate
