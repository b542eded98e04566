"""Forecast and arrival without training, beside balls that roll and arms that are driven."""

import pytest
import torch

from torchdyn_plan.envs.trapper import TrapperScene
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.nets.pretrained import Pretrained
from torchdyn_plan.planners import Delayed, KalmanTrack, TrackedPlanner
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.data import record_path
from torchdyn_plan.tasks.trapper.measured import MeasuredArrival
from torchdyn_plan.tasks.trapper.task import ik_planner
from torchdyn_plan.tasks.trapper.untrained import arm_arrival, billiard

SCENE = TrapperScene()


@pytest.fixture(scope="module")
def rolls():
    """Paths (48, 400, 3) of balls that nobody touches, of the split train."""
    place, speed = draw_starts(SCENE, torch.arange(48), velocity=3.0, split="train", seed=0)
    return record_path(SCENE, place, speed, steps=400, num_threads=1)


@pytest.mark.parametrize(("present", "ahead", "within"), [(30, 50, 0.02), (100, 75, 0.04)])
def test_balls_are_mostly_where_the_billiard_says(rolls, present, ahead, within):
    on_table = (rolls[:, present + ahead, 2] > 0.0).nonzero().squeeze(-1)
    forecast = billiard(SCENE).predict(rolls[on_table, present - 23 : present + 1])
    off = (forecast.path[:, ahead - 1] - rolls[on_table, present + ahead])[:, :2].norm(dim=-1)
    assert len(off) > 20
    assert (off < within).float().mean() > 0.7


def test_balls_that_fall_are_told_from_those_that_do_not(rolls):
    fell = rolls[:, 200, 2] < -SCENE.ball_radius
    gone = billiard(SCENE).predict(rolls[:, 7:31]).spread.gone[:, 169]
    still_there = rolls[:, 30, 2] > 0.0
    assert (fell & still_there).sum() >= 3
    assert gone[fell & still_there].mean() > gone[~fell].mean() + 0.3


def test_arms_come_when_the_limits_of_their_joints_say():
    joints = ik_planner(SCENE)
    goals = torch.tensor([[0.2, -0.3, 0.105], [-0.3, -0.2, 0.105], [0.0, -0.1, 0.105], [0.4, -0.5, 0.15]])
    home = torch.tensor(SCENE.home)
    state = torch.cat([home, torch.zeros(6), joints.arm(home)[:3, 3] + torch.tensor(SCENE.base_pos)])
    found = arm_arrival(SCENE, joints).arrival(state.view(1, 1, -1), goals.unsqueeze(0))
    truth = MeasuredArrival(ik_planner(SCENE), scene=SCENE, num_threads=1).arrival(
        state.view(1, 1, -1), goals.unsqueeze(0)
    )
    assert not found.never.any()
    assert not truth.never.any()
    assert (found.steps - truth.steps).abs().max() < 10.0


def test_it_has_no_networks_and_runs_only_when_it_is_named():
    task = load_task("trapper")
    planner = task.planner("untrained")
    assert not any(isinstance(module, Pretrained) for module in planner.modules())
    assert any(isinstance(module, Pretrained) for module in task.planner("wait_and_drop").modules())
    assert "untrained" not in task.default_planners


def test_it_traps_balls_and_so_it_does_behind_a_track_and_with_late_plans():
    from torchdyn_plan.evaluation import evaluate

    planner = load_task("trapper").planner("untrained")
    tracked = TrackedPlanner(planner, KalmanTrack(noise=1e-4), control_step=SCENE.control_step)
    found = evaluate(
        "trapper",
        {"alone": planner, "tracked": tracked},
        velocity=1.0,
        episodes=6,
        num_envs=6,
        split="dev",
        num_threads=1,
        delivery=Delayed(2),
        progress=False,
    )
    for name, outcomes in found.outcomes.items():
        solvable = outcomes.solvable
        assert (outcomes.success & solvable).sum() >= 0.75 * solvable.sum(), name
        assert outcomes.replans.sum() > 0
