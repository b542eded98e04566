import json

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from torchdyn_plan.cli_arguments import CollectArguments
from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.envs.episodes import draw_starts
from torchdyn_plan.envs.reaching import ReachingTask
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import IKPlanner
from torchdyn_plan.training import collect, runs
from torchdyn_plan.training.arrivals import load_arrivals
from torchdyn_plan.training.windows import load_paths

SCENE = TrapperScene()
PLAN = runs.trapper_runs(SCENE)
STEPS = 200


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(collect, "PATH_STEPS", STEPS)
    monkeypatch.setattr(collect, "SHARD", {"paths": 6, "arrivals": 24})
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def gather(out, what="paths", **settings):
    settings = {"episodes": 10, "num_envs": 4, "threads": 1, **settings}
    collect.collect(CollectArguments(what=what, out=out, **settings))
    return [load_file(file) for file in sorted(out.glob(f"{what}-*.safetensors"))]


@pytest.mark.usefixtures("short")
def test_paths_are_cut_where_the_ball_is_swallowed_and_laid_end_to_end(tmp_path):
    shards = gather(tmp_path)
    assert [len(shard["length"]) for shard in shards] == [6, 4]
    for shard in shards:
        assert torch.equal(shard["start"], shard["length"].cumsum(0) - shard["length"])
        assert shard["positions"].shape == (int(shard["length"].sum()), 3)
        assert shard["positions"].dtype == torch.float32
        for start, length, pocketed in zip(shard["start"], shard["length"], shard["pocketed"], strict=True):
            height = shard["positions"][start : start + length, 2]
            assert bool(pocketed) or length == STEPS + 1
            assert (height[:-1] >= -SCENE.ball_radius).all()
            assert bool(height[-1] < -SCENE.ball_radius) is bool(pocketed)
    assert torch.cat([shard["pocketed"] for shard in shards]).any()
    together = load_paths(tmp_path)
    assert together.length.shape == (10,)
    about = json.loads((tmp_path / "paths-0.json").read_text())
    assert about["scene"] == SCENE.digest()
    assert about["arguments"]["episodes"] == 10


@pytest.mark.usefixtures("short")
def test_paths_start_as_the_training_episodes_do_at_speeds_of_their_own(tmp_path):
    gather(tmp_path, seed=3)
    paths = load_paths(tmp_path)
    place, direction = draw_starts(SCENE, torch.arange(10), velocity=1.0, split="train", seed=3)
    first = paths.positions[paths.start]
    torch.testing.assert_close(first[:, :2].double(), place, atol=1e-6, rtol=0)
    speed = torch.cat([load_file(file)["velocity"] for file in sorted(tmp_path.glob("paths-*.safetensors"))])
    assert ((speed >= 0) & (speed <= collect.FASTEST)).all()
    assert len(speed.unique()) == 10
    moved = (paths.positions[paths.start + 1] - first)[:, :2].double() / SCENE.control_step
    torch.testing.assert_close(moved, direction * speed.unsqueeze(-1), atol=0.02, rtol=0)


@pytest.mark.usefixtures("short")
def test_paths_are_the_same_whatever_the_threads_and_others_with_another_seed(tmp_path):
    one, two, other = gather(tmp_path / "1"), gather(tmp_path / "2", threads=2), gather(tmp_path / "3", seed=1)
    for mine, same, different in zip(one, two, other, strict=True):
        assert all(torch.equal(mine[name], same[name]) for name in mine)
        assert not torch.equal(mine["velocity"], different["velocity"])


@pytest.mark.usefixtures("short")
def test_shards_there_are_are_kept_but_not_one_that_was_cut_short(tmp_path):
    gather(tmp_path, episodes=8)
    first, last = sorted(tmp_path.glob("paths-*.safetensors"))
    with safe_open(first, "pt") as content:
        save_file({"mark": torch.ones(1)}, first, content.metadata())
    shards = gather(tmp_path, episodes=10)
    assert list(shards[0]) == ["mark"]
    assert len(shards[1]["length"]) == 4
    stamp = last.stat().st_mtime_ns
    gather(tmp_path, episodes=10, threads=2)
    assert last.stat().st_mtime_ns == stamp


@pytest.mark.usefixtures("short")
def test_shards_of_another_collection_are_refused(tmp_path, monkeypatch):
    gather(tmp_path, episodes=6)
    with pytest.raises(InputError, match=r"paths-0-000.* num_envs is 4 there, 5 here"):
        gather(tmp_path, episodes=6, num_envs=5)
    monkeypatch.setattr(collect, "TrapperScene", lambda: TrapperScene(ball_mass=5.0))
    with pytest.raises(InputError, match=f"scene is {SCENE.digest()} there"):
        gather(tmp_path, episodes=6)
    (tmp_path / "paths-0-000.safetensors").write_bytes(b"cut")
    with pytest.raises(InputError, match=r"paths-0-000.*not a whole safetensors file"):
        gather(tmp_path, episodes=6)


@pytest.fixture(scope="module")
def arrivals(tmp_path_factory):
    """Samples of 24 sequences of runs, and those that stand at home at rest: at the start of a sequence."""
    out = tmp_path_factory.mktemp("arrivals")
    threads = torch.get_num_threads()
    gather(out, "arrivals", episodes=48, num_envs=48)
    torch.set_num_threads(threads)
    data = load_arrivals(out)
    home = (data.robot_state[:, :6] == torch.tensor(SCENE.home)).all(-1) & (data.robot_state[:, 6:12] == 0).all(-1)
    return data, home


def test_arrivals_have_shapes_and_runs(arrivals):
    data, home = arrivals
    assert data.robot_state.shape == (len(data.run), 15)
    assert data.arrival.dtype == data.run.dtype == torch.int64
    names, counts = data.run.unique(return_counts=True)
    assert (counts == runs.STATES_PER_RUN).all()
    assert len(names) > 48
    for run in names[:30]:
        rows = data.run == run
        assert len(data.goal[rows].unique(dim=0)) == 1
        label = data.arrival[rows]
        assert (label == -1).all() or ((label >= 0) & (label <= label[0])).all()
    assert data.arrival.max() <= PLAN.longest
    assert home.sum() >= 10
    assert 0.02 < (data.arrival < 0).float().mean() < 0.6


def test_the_label_is_what_a_new_run_from_home_takes(arrivals):
    data, home = arrivals
    rows = home.nonzero().squeeze(-1)[:24]
    goal, label = data.goal[rows], data.arrival[rows]
    assert (label > 20).any()
    assert (label < 0).any()
    task = ReachingTask(IKPlanner(), len(rows), num_threads=1)
    found = torch.full_like(label, -1)
    for step in range(PLAN.longest + 1):
        found = torch.where((found < 0) & task.is_reached(goal), step, found)
        task.step(goal)
    assert torch.equal(found, label)


def test_a_goal_beyond_the_rails_is_never_reached(arrivals):
    data, _ = arrivals
    beyond = (data.goal[:, :2].abs() > SCENE.half_side).any(-1)
    assert beyond.sum() >= 10
    assert (data.arrival[beyond] == -1).all()
    assert (data.arrival[~beyond] >= 0).any()


def test_goals_lie_on_the_table_above_it_and_outside():
    goal = runs.draw_goals(SCENE, 4000, torch.Generator().manual_seed(0))
    assert goal.shape == (4000, 3)
    inside = (goal[:, :2].abs() <= SCENE.half_side).all(-1)
    height = goal[:, 2]
    on_table = (height - SCENE.ball_radius).abs() <= 0.005
    above = height > SCENE.ball_radius + 0.01
    sunk = height <= 0
    assert (on_table | above | sunk).all()
    for kind, low in ((inside & on_table, 0.3), (inside & above, 0.1), (inside & sunk, 0.01), (~inside, 0.03)):
        assert low < kind.float().mean() < 0.8
    assert goal[:, :2].abs().amax() > 2.5
    near = (goal[:, :2] - torch.tensor(SCENE.base_pos[:2])).norm(dim=-1) < 0.9
    assert (near & on_table).float().mean() > 0.2
    for half in (goal[:, 0] < 0, goal[:, 0] > 0):
        assert 0.4 < half.float().mean() < 0.6
