"""Trapper's data: rolled balls and runs of the arm; and what the fits of its networks are told."""

import json

import pytest
import torch
from safetensors.torch import load_file

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.envs.trapper.arm_runner import TrapperArmRunner
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.planners import LostBelow, PolicyPlanner
from torchdyn_plan.tasks.trapper import data as module
from torchdyn_plan.tasks.trapper.data import (
    AT_REST,
    FASTEST,
    draw_goals,
    other_frictions,
    record_arm_runs,
    record_rolls,
    rolled_windows,
    run_plan,
    trapper_fitting,
)
from torchdyn_plan.tasks.trapper.task import TASK, ik_planner
from torchdyn_plan.training import shards
from torchdyn_plan.training.arrival_data import Arrivals
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.runs import STATES_PER_RUN
from torchdyn_plan.training.windows import WindowConfig, load_paths

SCENE = TrapperScene()
PLAN = run_plan(SCENE)
STEPS = 200


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(module, "PATH_STEPS", STEPS)
    monkeypatch.setattr(shards, "SHARD", {"paths": 6, "arrivals": 24})


def gather(out, **settings):
    collect(TASK, "paths", out, **{"episodes": 10, "num_envs": 4, "num_threads": 1, **settings})
    return [load_file(file) for file in sorted(out.glob("paths-*.safetensors"))]


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
    assert ((speed >= 0) & (speed <= FASTEST)).all()
    assert len(speed.unique()) == 10
    moved = (paths.positions[paths.start + 1] - first)[:, :2].double() / SCENE.control_step
    torch.testing.assert_close(moved, direction * speed.unsqueeze(-1), atol=0.02, rtol=0)


@pytest.mark.usefixtures("short")
def test_paths_are_the_same_whatever_the_threads_and_others_with_another_seed():
    blocks = [torch.arange(4), torch.arange(4, 7)]
    one, two = (record_rolls(blocks, seed=0, num_threads=threads) for threads in (1, 2))
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert not torch.equal(one["velocity"], record_rolls(blocks, seed=1, num_threads=1)["velocity"])


@pytest.fixture(scope="module")
def arrivals():
    """Samples of 48 sequences of runs, and those that stand at home at rest: at the start of a sequence."""
    data = Arrivals(**record_arm_runs(ik_planner(), num_envs=48, sequences=1, seed=0, num_threads=1))
    home = (data.robot_state[:, :6] == torch.tensor(SCENE.home)).all(-1) & (data.robot_state[:, 6:12] == 0).all(-1)
    return data, home


def test_arrivals_have_shapes_and_runs(arrivals):
    data, home = arrivals
    assert data.robot_state.shape == (len(data.run), 15)
    assert data.arrival.dtype == data.run.dtype == torch.int64
    names, counts = data.run.unique(return_counts=True)
    assert (counts == STATES_PER_RUN).all()
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
    runner = TrapperArmRunner(ik_planner(), len(rows), num_threads=1)
    found = torch.full_like(label, -1)
    for step in range(PLAN.longest + 1):
        found = torch.where((found < 0) & runner.is_reached(goal), step, found)
        runner.step(goal)
    assert torch.equal(found, label)


def test_a_goal_beyond_the_rails_is_never_reached(arrivals):
    data, _ = arrivals
    beyond = (data.goal[:, :2].abs() > SCENE.half_side).any(-1)
    assert beyond.sum() >= 10
    assert (data.arrival[beyond] == -1).all()
    assert (data.arrival[~beyond] >= 0).any()


@pytest.mark.parametrize(("static", "rests"), [("ik", True), ("rl", False)])
def test_an_arm_that_never_rests_is_given_up_for_good(static, rests, monkeypatch):
    plans = []

    def keep(runner, plan, **how):
        plans.append(plan)
        return {}

    monkeypatch.setattr(module, "record_runs", keep)
    planner = TASK.static_planner(static)
    assert isinstance(planner, PolicyPlanner) is not rests
    record_arm_runs(planner, num_envs=1, sequences=1, seed=0, num_threads=1)
    assert [plan.comes_to_rest for plan in plans] == [rests]


def test_goals_lie_on_the_table_above_it_and_outside():
    goal = draw_goals(SCENE, 4000, torch.Generator().manual_seed(0))
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


def test_arrivals_are_grouped_by_height_and_joint_speed():
    state = torch.zeros(3, 15)
    state[1, 7], state[2, 0] = -20 * AT_REST, 5.0
    goal = torch.tensor([[0.0, 0.0, 0.03], [0.0, 0.0, 0.2], [0.0, 0.0, 0.047]])
    run = torch.arange(3)
    groups = trapper_fitting().groups(Arrivals(state, goal, torch.tensor([29, 30, -1]), run, run))
    assert groups["on table"].tolist() == [True, False, True]
    assert groups["above table"].tolist() == [False, True, False]
    assert groups["at rest"].tolist() == [True, False, True]


def test_what_the_fits_are_told_follows_from_the_scene():
    fitting, other = trapper_fitting(), trapper_fitting(TrapperScene(table_side=1.4, box_half_width=0.075))
    assert fitting.near == pytest.approx(0.055)
    assert other.near == pytest.approx(0.065)
    assert fitting.forecaster.half_extent == SCENE.half_side - SCENE.ball_radius
    assert other.forecaster.half_extent == pytest.approx(0.7 - SCENE.ball_radius)
    assert fitting.lost == LostBelow(seen_below=-SCENE.ball_radius, forecast_below=0.0)


def test_windows_of_rolled_balls_brake_with_friction(monkeypatch):
    monkeypatch.setattr(module, "ROLLED", 8)
    monkeypatch.setattr(module, "PRESENTS", (40,))
    way = {}
    for friction in (0.0, 9.5):
        windows = rolled_windows(SCENE, WindowConfig(), friction=friction)
        assert windows.future.shape[1:] == (300, 3)
        way[friction] = windows.future[:, :50].diff(dim=1).norm(dim=-1).sum(1).mean()
    assert way[9.5] < way[0.0]
    monkeypatch.setattr(module, "FRICTIONS", (0.0, 9.5))
    extra = other_frictions(SCENE, WindowConfig())
    assert [columns for columns, _ in extra.windows] == [{"friction": 0.0}, {"friction": 9.5}]
    assert "3 m/s" in extra.caption
