from dataclasses import replace

import pytest
import torch

from torchdyn_plan.envs import EnvRunner
from torchdyn_plan.envs.conveyor import ConveyorEnv
from torchdyn_plan.kinematics.quaternions import quat_matrix
from torchdyn_plan.nets import ETANetwork
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.conveyor.data import conveyor_fitting, draw_poses, record_belts, run_plan
from torchdyn_plan.training.arrival_data import load_arrivals
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.runs import record_runs
from torchdyn_plan.training.windows import load_paths

TASK = load_task("conveyor")


def test_its_paths_are_those_of_the_simulated_belt():
    data = record_belts([torch.arange(50)], seed=0)
    step = data["positions"].view(50, -1, 3).diff(dim=1)
    torch.testing.assert_close(step[:, :, 1].mean(1) / 0.02, data["velocity"], atol=1e-4, rtol=0)
    assert data["velocity"].min() < 0.1 < 0.9 < data["velocity"].max()
    env = ConveyorEnv(2, speed=0.5, seed=0, split="train", num_threads=1)
    td, places = env.reset(), []
    for _ in range(20):
        td = env.step(td.set("action", torch.zeros(2, 7)))["next"]
        places.append(td["target_pos"])
    moves = torch.stack(places).diff(dim=0)
    torch.testing.assert_close(moves, torch.tensor([0.0, 0.01, 0.0]).expand(19, 2, 3), atol=5e-5, rtol=0)


def test_its_goals_are_aligned_with_parts():
    goal = draw_poses(300, torch.Generator().manual_seed(0))
    down = quat_matrix(goal[:, 3:])
    torch.testing.assert_close(down[..., 2], torch.tensor([0.0, 0.0, -1.0]).expand(300, 3), atol=1e-5, rtol=0)
    # Of two alike the one that faces along x and y is taken.
    assert (down[..., 0] @ torch.tensor([1.0, 1.0, 0.0])).min() > -1e-5


def test_paths_are_collected(tmp_path):
    collect(TASK, "paths", tmp_path, episodes=2, num_threads=1)
    assert len(load_paths(tmp_path).length) == 2


@pytest.mark.slow
def test_arrivals_are_collected(tmp_path):
    collect(TASK, "arrivals", tmp_path, episodes=2, num_envs=2, num_threads=1)
    arrivals = load_arrivals(tmp_path, state_size=conveyor_fitting().eta.robot_state_size)
    assert arrivals.goal.shape == (len(arrivals.run), 7)
    assert (arrivals.arrival > 0).any()


def test_arrivals_are_those_of_the_static_planner_and_are_read_by_its_network():
    planner = TASK.static_planner()
    runner = EnvRunner(planner, ConveyorEnv(4, speed=2.0, seed=0, split="train", num_threads=1), at_goal=planner.is_at)
    data = record_runs(runner, replace(run_plan(), sequence=12, longest=10, redirected=0.0), sequences=1, seed=0)
    assert (data["arrival"] <= 10).all()
    assert torch.equal(data["robot_state"][0], runner.env.reset()["robot_state"][0])
    assert conveyor_fitting().eta.bins * conveyor_fitting().eta.bin_width >= run_plan().longest
    assert ETANetwork(conveyor_fitting().eta)(data["robot_state"], data["goal"]).isfinite().all()


def test_its_learned_planner_plans_with_its_networks():
    env = ConveyorEnv(2, parts=2, seed=0, split="dev", num_threads=1)
    with torch.no_grad():
        seen = env.rollout(6, TASK.planner("learned"), break_when_any_done=False)
    assert seen["action"].shape == (2, 6, 7)
    assert seen["goal_pose"].isfinite().all()
    assert (seen["plan", "status"][:, -1] == 0).any()
