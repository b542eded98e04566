import torch

from torchdyn_plan.envs.fetch_reach.arm_runner import FetchArmRunner
from torchdyn_plan.envs.fetch_reach.env import STATE_SIZE, DynamicReachEnv
from torchdyn_plan.envs.fetch_reach.goal_motion import HEIGHT
from torchdyn_plan.tasks.fetch_reach.data import (
    ARRIVAL,
    FASTEST,
    PATH_STEPS,
    fetch_reach_fitting,
    record_fetch_runs,
    record_goal_paths,
)
from torchdyn_plan.tasks.fetch_reach.task import TASK
from torchdyn_plan.training.arrival_data import Arrivals
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.windows import WindowConfig, draw_windows, last_useful_step, load_paths


def test_paths_go_every_way_at_speeds_up_to_the_fastest():
    data = record_goal_paths([torch.arange(400)], seed=0)
    paths = data["positions"].view(400, PATH_STEPS + 1, 3)
    step = paths.diff(dim=1)
    assert step.norm(dim=-1).max() <= FASTEST
    straight = (step - step[:, :1]).norm(dim=-1).amax(-1) < 1e-5
    along_x = straight & (step[:, 0, 1].abs() < 1e-6) & (step[:, 0, 0] > 0)
    assert 0.5 < along_x.float().mean() < 0.7
    assert 0.05 < (straight & ~along_x).float().mean() < 0.2
    assert data["velocity"].std() > 0.01


def test_a_path_is_a_function_of_seed_and_episode_however_they_are_cut_into_blocks():
    one = record_goal_paths([torch.arange(20)], seed=3)
    other = record_goal_paths([torch.arange(12), torch.arange(12, 20)], seed=3)
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert not torch.equal(one["positions"], record_goal_paths([torch.arange(20)], seed=4)["positions"])


def test_windows_may_begin_with_the_first_sample(tmp_path):
    collect(TASK, "paths", tmp_path, episodes=40, num_envs=32, num_threads=1)
    paths, drawing = load_paths(tmp_path), WindowConfig(history=8, horizon=50, first_step=0, early_share=1.0)
    windows = draw_windows(
        paths, last_useful_step(paths, drawing), torch.arange(40).repeat(20), drawing, torch.Generator().manual_seed(0)
    )
    assert windows.recorded.all()
    fresh = windows.history_length == 0
    assert fresh.any()
    assert (windows.history[fresh] == windows.history[fresh][:, :1]).all()


def test_the_label_is_what_a_new_run_takes():
    planner = TASK.static_planner("proportional")
    data = record_fetch_runs(planner, num_envs=24, sequences=1, seed=0, num_threads=1)
    assert data["robot_state"].shape == (len(data["run"]), 10)
    runner = FetchArmRunner(planner, 24, threshold=ARRIVAL, num_threads=1)
    start = (data["robot_state"] - runner.robot_state[0]).abs().amax(-1) == 0
    rows = start.nonzero().squeeze(-1)[:24]
    goal, label = data["goal"][rows], data["arrival"][rows]
    assert len(rows) > 5
    found = torch.full_like(label, -1)
    goals = torch.cat([goal, goal[-1:].expand(24 - len(goal), 3)])
    for step in range(61):
        at = runner.is_reached(goals)[: len(rows)]
        found = torch.where((found < 0) & at, step, found)
        runner.step(goals)
    assert (found[label >= 0] == label[label >= 0]).all()
    assert 0.02 < (data["arrival"] < 0).float().mean() < 0.5


def test_arrivals_are_grouped_by_height_and_gripper_speed():
    state = torch.zeros(3, STATE_SIZE)
    state[1, 6] = 0.01
    goal = torch.tensor([[1.3, 0.7, HEIGHT], [1.3, 0.7, 0.6], [1.3, 0.7, HEIGHT]])
    run = torch.arange(3)
    groups = fetch_reach_fitting().groups(Arrivals(state, goal, torch.tensor([29, 30, -1]), run, run))
    assert groups["level"].tolist() == [True, False, True]
    assert groups["in motion"].tolist() == [False, True, False]


def test_networks_fit_the_environment():
    fitting, env = fetch_reach_fitting(), DynamicReachEnv(1, seed=0, num_threads=1)
    td = env.reset()
    assert td["target_history"].shape[-2] == fitting.forecaster.history
    assert td["robot_state"].shape[-1] == fitting.eta.robot_state_size
    assert torch.equal(td["robot_state"][:, slice(*fitting.eta.tool_slice)], td["tool_pos"])
    assert fitting.eta.bins * fitting.eta.bin_width == env.max_steps
