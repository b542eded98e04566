import pytest
import torch

from torchdyn_plan.cli_arguments import CollectArguments
from torchdyn_plan.envs.fetch_reaching import FetchReachingTask
from torchdyn_plan.errors import InputError, UsageError
from torchdyn_plan.planners.proportional import ProportionalController
from torchdyn_plan.training.arrivals import load_arrivals
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.reach_data import ARRIVAL, FASTEST, PATH_STEPS, record_fetch_runs, record_goal_paths
from torchdyn_plan.training.windows import WindowConfig, draw_windows, last_useful_step, load_paths


def gather(out, what="paths", **settings):
    threads = torch.get_num_threads()
    collect(CollectArguments(**{"what": what, "task": "reach", "out": out, "threads": 1, "num_envs": 32, **settings}))
    torch.set_num_threads(threads)


def test_paths_go_every_way_at_speeds_up_to_the_fastest():
    data = record_goal_paths(torch.arange(400), seed=0)
    paths = data["positions"].view(400, PATH_STEPS + 1, 3)
    step = paths.diff(dim=1)
    assert step.norm(dim=-1).max() <= FASTEST
    straight = (step - step[:, :1]).norm(dim=-1).amax(-1) < 1e-5
    along_x = straight & (step[:, 0, 1].abs() < 1e-6) & (step[:, 0, 0] > 0)
    assert 0.5 < along_x.float().mean() < 0.7
    assert 0.05 < (straight & ~along_x).float().mean() < 0.2
    assert data["velocity"].std() > 0.01


def test_a_path_is_a_function_of_seed_and_episode():
    one, other = record_goal_paths(torch.arange(20), seed=3), record_goal_paths(torch.arange(20), seed=3)
    assert torch.equal(one["positions"], other["positions"])
    assert not torch.equal(one["positions"], record_goal_paths(torch.arange(20), seed=4)["positions"])


def test_windows_may_begin_with_the_first_sample(tmp_path):
    gather(tmp_path, episodes=40)
    paths, drawing = load_paths(tmp_path), WindowConfig(history=8, horizon=50, first_step=0, early_share=1.0)
    windows = draw_windows(
        paths, last_useful_step(paths, drawing), torch.arange(40).repeat(20), drawing, torch.Generator().manual_seed(0)
    )
    assert windows.recorded.all()
    fresh = windows.history_length == 0
    assert fresh.any()
    assert (windows.history[fresh] == windows.history[fresh][:, :1]).all()


def test_the_label_is_what_a_new_run_takes():
    data = record_fetch_runs(ProportionalController(), 24, 1, seed=0, num_threads=1)
    assert data["robot_state"].shape == (len(data["run"]), 10)
    task = FetchReachingTask(ProportionalController(), 24, threshold=ARRIVAL, num_threads=1)
    start = (data["robot_state"] - task.robot_state[0]).abs().amax(-1) == 0
    rows = start.nonzero().squeeze(-1)[:24]
    goal, label = data["goal"][rows], data["arrival"][rows]
    assert len(rows) > 5
    found = torch.full_like(label, -1)
    goals = torch.cat([goal, goal[-1:].expand(24 - len(goal), 3)])
    for step in range(61):
        at = task.is_reached(goals)[: len(rows)]
        found = torch.where((found < 0) & at, step, found)
        task.step(goals)
    assert (found[label >= 0] == label[label >= 0]).all()
    assert 0.02 < (data["arrival"] < 0).float().mean() < 0.5


def test_data_of_one_task_is_not_taken_for_the_others(tmp_path):
    gather(tmp_path, "arrivals", episodes=32)
    assert len(load_arrivals(tmp_path).run) > 100
    with pytest.raises(InputError, match="scene is"):
        collect(CollectArguments(what="arrivals", out=tmp_path, episodes=32, num_envs=32, threads=1))


def test_a_static_planner_of_another_task_is_named():
    with pytest.raises(UsageError, match="proportional"):
        CollectArguments(what="arrivals", task="reach", static="ik")
