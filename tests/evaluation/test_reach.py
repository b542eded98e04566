import dataclasses

import pytest
import torch

from torchdyn_plan import keys
from torchdyn_plan.cli_arguments import EvaluateArguments, SweepArguments
from torchdyn_plan.errors import UsageError
from torchdyn_plan.evaluation.planners import EXACT
from torchdyn_plan.evaluation.plots import plot_reach
from torchdyn_plan.evaluation.reach import goal_path, run_episodes, run_reach
from torchdyn_plan.evaluation.report import format_table
from torchdyn_plan.evaluation.results import summarize
from torchdyn_plan.nets.eta import Arrival
from torchdyn_plan.planners import DynamicPlanner, ReplanSchedule, TargetPursuit
from torchdyn_plan.planners.baselines import RecordedFuture
from torchdyn_plan.planners.proportional import ProportionalController

EVERY_STEP = ReplanSchedule(first_step=0, window=1, shrink=1.0, minimum=1)


class StrideArrival(torch.nn.Module):
    """An arm that moves 3 cm a step along every axis, and has arrived within 1 cm."""

    def arrival(self, robot_state, goal, *, reading="mode"):
        away = (goal - robot_state[..., :3]).abs().amax(-1)
        steps = ((away - 0.008) / 0.03).ceil().clamp_min(0.0)
        return Arrival(steps, steps > 40)


def setting(**changes):
    return EvaluateArguments(
        **{"task": "reach", "velocity": 0.031, "episodes": 24, "num_envs": 24, "threads": 1, "split": "dev", **changes}
    )


def oracle(static=None):
    static = static or ProportionalController()
    return DynamicPlanner(static, RecordedFuture(50), StrideArrival(), search=EXACT["reach"], schedule=EVERY_STEP)


@pytest.fixture(scope="module")
def outcomes():
    planners = {"oracle": oracle(), "pursuit": TargetPursuit(ProportionalController())}
    return run_reach(planners, setting())


def test_the_dynamic_planner_meets_what_can_be_met_and_pursuit_does_not(outcomes):
    found = outcomes["oracle"]
    assert found.solvable.double().mean() > 0.4
    assert (found.trapped & found.solvable).sum() >= 0.9 * found.solvable.sum()
    assert outcomes["pursuit"].trapped.sum() < 0.6 * found.trapped.sum()
    assert not (found.steps[found.trapped] == 0).any()
    assert (found.replans > 1).all()


def test_outcomes_do_not_depend_on_how_many_run_side_by_side(outcomes):
    arguments = setting(num_envs=7)
    planners = {"oracle": oracle()}
    again = run_reach(planners, arguments)["oracle"]
    for name in ("trapped", "steps", "solvable"):
        assert torch.equal(getattr(again, name), getattr(outcomes["oracle"], name)), name


def test_the_recorded_future_is_what_happens():
    from torchdyn_plan.envs import DynamicReachEnv
    from torchdyn_plan.envs.goal_motion import draw_goals

    env = DynamicReachEnv(3, velocity=0.05, motion="circle", split="dev", num_threads=1)
    starts = draw_goals(
        torch.arange(3), env.simulation.start.tool_pos, motion="circle", goal_range=0.1, split="dev", seed=0
    )
    path = goal_path(starts, setting(motion="circle", velocity=0.05), 10)
    rollout = env.rollout(10)
    torch.testing.assert_close(rollout["next", keys.TARGET_POS], path[:, 1:])


def test_tables_and_plots_name_the_paper(outcomes, tmp_path):
    rows = [
        summarize(outcome, planner=name, static="proportional", velocity=0.031, friction=0.0, task="reach")
        for name, outcome in (("corner", outcomes["oracle"]), ("pursuit", outcomes["pursuit"]))
    ]
    assert [row.paper_success for row in rows] == [0.618, None]
    table = format_table(rows)
    assert "0.031 m a step" in table
    assert "62 %" in table
    assert "pocketed" not in table
    more = [dataclasses.replace(row, velocity=0.041) for row in rows]
    plot_reach(rows + more, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_other_readings_of_the_task_change_what_is_solved(outcomes):
    near = run_reach({"oracle": oracle()}, setting(threshold=0.05))["oracle"]
    far = run_reach({"oracle": oracle()}, setting(goal_range=0.3))["oracle"]
    for name in ("solvable", "trapped"):
        usual, more, fewer = (getattr(found, name).sum() for found in (outcomes["oracle"], near, far))
        assert fewer < usual < more, name


def test_episodes_that_cannot_be_reached_are_no_success():
    class Nothing(torch.nn.Module):
        def forward(self, td):
            return td.set(keys.ACTION, torch.zeros(*td.batch_size, 4))

    arguments = setting(episodes=4, num_envs=4, velocity=0.1)
    found = run_episodes(Nothing(), arguments, torch.zeros(4, 60, 3), torch.ones(4, dtype=torch.bool), "nothing")
    assert not found.trapped.any()
    assert found.steps.tolist() == [-1] * 4


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"task": "raech"}, "did you mean 'reach'"),
        ({"planners": ("meet",)}, "meet"),
        ({"static": "ik"}, "unknown static planner 'ik'"),
        ({"velocity": 3.0}, "velocity"),
        ({"friction": 1.0}, "friction"),
        ({"motion": "zigzag"}, "zigzag"),
        ({"task": "trapper", "motion": "circle", "velocity": 1.0}, "motion"),
        ({"task": "trapper", "goal_range": 0.15, "velocity": 1.0}, "goal_range"),
        ({"task": "trapper", "threshold": 0.02, "velocity": 1.0}, "threshold"),
        ({"threshold": 0.0}, "threshold"),
        ({"goal_range": -0.1}, "goal_range"),
    ],
)
def test_bad_settings_are_named(changes, named):
    with pytest.raises(UsageError, match=named):
        setting(**changes)


def test_tasks_fill_in_their_own_names(tmp_path):
    assert setting().static == "proportional"
    assert setting().planners == ("pursuit", "corner", "oracle", "exact")
    assert EvaluateArguments().static == "ik"
    sweep = SweepArguments(task="reach", over="velocity", out=tmp_path)
    assert sweep.point(0.021, 0).task == "reach"
    assert sweep.planners == setting().planners
    with pytest.raises(UsageError, match="over must be velocity"):
        SweepArguments(task="reach", over="friction", out=tmp_path)
