import torch

from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.attempts import CONFIG, explorer, record_attempts, record_block
from torchdyn_plan.tasks.trapper.wait_and_drop import waiting_search
from torchdyn_plan.training.capture_data import Captures


def test_attempts_are_recorded_with_what_came_of_them():
    draw = torch.Generator().manual_seed(0)
    env = TrapperEnv(20, velocity=5.0, seed=3, split="train", max_steps=220, num_threads=1)
    found = record_block(explorer(load_task("trapper").planner("wait_and_drop"), draw), env, draw, first=7)
    count = len(found.run)
    assert count >= 8
    assert found.window.shape == (count, CONFIG.positions, 2)
    assert found.goal.shape == (count, 2)
    assert 0 < int(found.captured.sum()) < count
    assert set(found.run.tolist()) <= set(range(7, 27))
    # At the middle of a window the target comes within the footprint of the place.
    come = (found.window[:, CONFIG.positions // 2] - found.goal).abs().amax(-1)
    assert float(come.max()) < waiting_search(TrapperScene()).footprint + 0.03


def test_blocks_are_laid_end_to_end(monkeypatch):
    known = []

    def block(planner, env, draw, *, first):
        known.append((env.num_envs, env.velocity, env.scene))
        size = torch.full((2,), first)
        return Captures(torch.zeros(2, 17, 2), torch.zeros(2, 2), size > 0, size)

    monkeypatch.setattr("torchdyn_plan.tasks.trapper.attempts.record_block", block)
    planner, blocks = load_task("trapper").planner("wait_and_drop"), [torch.arange(4), torch.arange(4, 7)]
    found = record_attempts(planner, blocks, seed=0, num_threads=1, scene="paper")
    assert found.keys() == {"window", "goal", "captured", "run"}
    assert found["run"].tolist() == [0, 0, 4, 4]
    assert [count for count, _, _ in known] == [4, 3]
    assert known[0][1] != known[1][1]
    assert known[0][2].digest() == load_task("trapper", "paper").digest()
