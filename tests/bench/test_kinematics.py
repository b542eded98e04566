from dataclasses import replace

import pytest
import torch

from tests.bench.columns import COLUMNS
from torchdyn_plan.bench import kinematics as bench_kinematics
from torchdyn_plan.bench.damped_steps import DampedSteps
from torchdyn_plan.bench.rivals import Mink, Pinocchio, PytorchKinematics, installed
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.tasks import load_task

TASK = load_task("trapper")
RIVALS = [PytorchKinematics, Pinocchio, Mink]


@pytest.fixture(scope="module")
def rows():
    return bench_kinematics.bench(batches=(1, 3), seconds=0.0, compiled=False)


def test_every_row_has_its_columns_and_a_small_error(rows):
    for row in rows:
        assert row.keys() >= COLUMNS
        assert row["median_us"] > 0.0
        assert row["max_error"] < (0.02 if row["what"] == "solution" else 1e-4), row
    ours = [row for row in rows if row["implementation"] == "torchdyn_plan"]
    assert [row["what"] for row in ours if row["batch"] == 3] == [
        "pose and Jacobian",
        "five damped steps",
        "IKPlanner step",
        "IKPlanner call",
    ]
    assert ours[-1]["what"] == "solution"
    assert ours[-1]["solved"] == 1.0


def test_a_task_without_inverse_kinematics_has_no_rows_of_a_planner():
    rl = replace(TASK, static_planners={"rl": TASK.static_planners["rl"]})
    rows = bench_kinematics.bench(rl, batches=(2,), seconds=0.0, compiled=False, rivals=False)
    assert {row["what"] for row in rows} == {"pose and Jacobian", "five damped steps", "solution"}


def test_the_plot_is_written(rows, tmp_path):
    bench_kinematics.plot(rows, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("kind", RIVALS)
def test_other_libraries_solve_the_same_problem(kind):
    if not (other := installed((kind,))):
        pytest.skip("not installed")
    arm = Arm.ur5(dtype=torch.float64)
    q, target = bench_kinematics.problem(4)
    pose, jacobian = arm.pose_and_jacobian(q.double())
    found = other[0].pose_and_jacobian(q)()
    torch.testing.assert_close(bench_kinematics._doubles(found[0]), pose, atol=1e-5, rtol=0)
    torch.testing.assert_close(bench_kinematics._doubles(found[1]), jacobian, atol=1e-5, rtol=0)
    reached = bench_kinematics._doubles(other[0].steps(q, target)())
    expected = DampedSteps(arm)(q.double(), target.double())
    torch.testing.assert_close(reached, expected, atol=1e-3, rtol=0)


def test_a_wrong_result_shows_as_an_error():
    arm = Arm.ur5()
    q, target = bench_kinematics.problem(4)
    pose, jacobian = arm.pose_and_jacobian(q)
    assert bench_kinematics._pose_error(q, (pose, jacobian))["max_error"] < 1e-5
    assert bench_kinematics._pose_error(q, (pose, jacobian + 0.1))["max_error"] > 0.09
    assert bench_kinematics._distance(target, q)["max_error"] > 0.01
    solutions = bench_kinematics._solved(arm(q), torch.cat([q[:3], q[3:] + 0.1]))
    assert solutions["solved"] == 0.75


def test_a_library_that_is_not_installed_is_left_out():
    class Missing:
        def __init__(self):
            raise ImportError

    assert installed((Missing,)) == []
