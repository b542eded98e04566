from dataclasses import replace

import pytest
import torch

from torchdyn_plan.envs import EnvRunner, Sensor
from torchdyn_plan.envs.catch import CatchEnv
from torchdyn_plan.kinematics.quaternions import quat_matrix
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import BallisticTrack, TrackedPlanner
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.catch.data import catch_fitting, draw_poses, record_flights, run_plan
from torchdyn_plan.training.arrival_data import load_arrivals
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.runs import record_runs
from torchdyn_plan.training.windows import load_paths

TASK = load_task("catch")


def test_its_flights_fall_and_half_of_them_are_those_of_tennis_balls():
    data = record_flights([torch.arange(200)], seed=0)
    path = data["positions"].view(200, -1, 3)
    change = path.double().diff(dim=1).diff(dim=1)[:, :40] / 0.008**2
    velocity = path.double().diff(dim=1)[:, :40] / 0.008
    change[..., 2] += 9.81
    drag = -(change * velocity).sum((1, 2)) / (velocity.norm(dim=-1) ** 3).sum(1)
    tennis = (drag - 0.0195).abs() < 3e-3
    assert 0.4 < tennis.double().mean() < 0.6
    assert drag.max() > 0.08
    assert drag.min() > -3e-3


def test_its_goals_are_turned_against_balls():
    goal = draw_poses(300, torch.Generator().manual_seed(0))
    mouth = quat_matrix(goal[:, 3:])[..., 2]
    # Balls come from along x.
    assert mouth[:, 0].min() > 0.1
    assert goal[:, 0].min() < 0.5 < 2.0 < goal[:, 0].max()


def test_paths_are_collected(tmp_path):
    collect(TASK, "paths", tmp_path, episodes=2, num_threads=1)
    assert len(load_paths(tmp_path).length) == 2


@pytest.mark.slow
def test_arrivals_are_collected(tmp_path):
    collect(TASK, "arrivals", tmp_path, episodes=2, num_envs=2, num_threads=1)
    arrivals = load_arrivals(tmp_path, state_size=catch_fitting().eta.robot_state_size)
    assert arrivals.goal.shape == (len(arrivals.run), 7)
    assert (arrivals.arrival > 0).any()


def test_arrivals_are_those_of_the_static_planner_and_are_read_by_its_network():
    planner = TASK.static_planner()
    runner = EnvRunner(planner, CatchEnv(4, seed=0, split="train", num_threads=1), at_goal=planner.is_at)
    data = record_runs(runner, replace(run_plan(), sequence=12, longest=10, redirected=0.0), sequences=1, seed=0)
    assert (data["arrival"] <= 10).all()
    assert torch.equal(data["robot_state"][0], runner.env.reset()["robot_state"][0])
    assert catch_fitting().eta.bins * catch_fitting().eta.bin_width >= run_plan().longest
    assert ETANetwork(catch_fitting().eta)(data["robot_state"], data["goal"]).isfinite().all()


def test_its_forecasters_know_drag():
    history = record_flights([torch.arange(64)], seed=1)["positions"].view(64, -1, 3)
    with torch.no_grad():
        path = Forecaster.from_pretrained("catch")(history[:, 13:21])
    law = Forecaster(catch_fitting().forecaster).law.predict(history[:, 13:21]).path
    learned, analytic = ((one[:, -1] - history[:, 145]).norm(dim=-1) for one in (path, law))
    assert learned.median() < 0.05
    assert learned.quantile(0.9) < 0.5 * analytic.quantile(0.9)


@pytest.mark.parametrize("sensor", [None, Sensor(noise=0.003, rate=60.0)])
def test_its_learned_planner_plans_with_its_networks(sensor):
    env = CatchEnv(2, seed=0, split="dev", sensor=sensor, num_threads=1)
    planner = TASK.planner("learned")
    if sensor is not None:
        planner = TrackedPlanner(planner, BallisticTrack(noise=0.003), control_step=env.control_step)
        assert planner.planner.forecaster.config.tracked
    with torch.no_grad():
        seen = env.rollout(10, planner, break_when_any_done=False)
    assert seen["action"].shape == (2, 10, 6)
    assert seen["goal_pose"].isfinite().all()
    assert (seen["plan", "status"][:, -1] == 0).any()
