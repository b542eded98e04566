import dataclasses
import json

import pytest
import torch

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.evaluation.episodes import run_episodes
from torchdyn_plan.evaluation.plots import plot_sweep
from torchdyn_plan.evaluation.report import format_table
from torchdyn_plan.evaluation.sweep import default_values, sweepable
from torchdyn_plan.nets.arrival import Arrival, ArrivalModel
from torchdyn_plan.planners import ExactSearch, ReplanSchedule, TargetPursuit, oracle_trajectory
from torchdyn_plan.tasks.fetch_reach.ceiling import goal_path
from torchdyn_plan.tasks.fetch_reach.task import TASK
from torchdyn_plan.tasks.task import Truth

EVERY_STEP = ReplanSchedule.every(1, first_step=0)


class StrideArrival(ArrivalModel):
    """An arm that moves 3 cm a step along every axis, and has arrived within 1 cm."""

    def arrival(self, robot_state, goal, *, estimator="mode"):
        away = (goal - robot_state[..., :3]).abs().amax(-1)
        steps = ((away - 0.008) / 0.03).ceil().clamp_min(0.0)
        return Arrival(steps, steps > 40)


def oracle():
    search = ExactSearch(stride=1, first=1)
    return oracle_trajectory(TASK.static_planner(), StrideArrival(), horizon=50, search=search, schedule=EVERY_STEP)


def play(planners, **changes):
    how = {"velocity": 0.031, "episodes": 24, "num_envs": 24, "num_threads": 1, "split": "dev", "progress": False}
    return evaluate(TASK, planners, **(how | changes))


@pytest.fixture(scope="module")
def found():
    return play({"oracle": oracle(), "pursuit": TargetPursuit(TASK.static_planner())})


def test_the_dynamic_planner_meets_what_can_be_met_and_pursuit_does_not(found):
    met = found.outcomes["oracle"]
    assert met.solvable.double().mean() > 0.4
    assert (met.success & met.solvable).sum() >= 0.9 * met.solvable.sum()
    assert found.outcomes["pursuit"].success.sum() < 0.6 * met.success.sum()
    assert not (met.steps[met.success] == 0).any()
    assert (met.replans > 1).all()


def test_outcomes_do_not_depend_on_how_many_run_side_by_side(found):
    again = play({"oracle": oracle()}, num_envs=7).outcomes["oracle"]
    for name in ("success", "steps", "replans", "solvable"):
        assert torch.equal(getattr(again, name), getattr(found.outcomes["oracle"], name)), name


def test_outcomes_have_the_tasks_own_words(found, tmp_path):
    found.save(tmp_path)
    content = json.loads((tmp_path / "episodes.json").read_text())["oracle"]
    assert set(content) == {"reached", "steps", "replans", "solvable", "seconds"}
    row = json.loads((tmp_path / "results.json").read_text())["rows"][0]
    assert row["failures"] == {}
    assert not {"trapped", "pocketed", "touched", "steps_to_trap"} & set(row)
    table = found.table()
    assert "steps to reach" in table
    assert "trap" not in table
    assert "pocketed" not in table


def test_the_recorded_future_is_what_happens():
    from torchdyn_plan.envs import DynamicReachEnv
    from torchdyn_plan.envs.fetch_reach.goal_motion import draw_goals

    env = DynamicReachEnv(3, velocity=0.05, motion="circle", split="dev", seed=0, num_threads=1)
    start = env.simulation.start.tool_pos
    starts = draw_goals(torch.arange(3), start, motion="circle", goal_range=0.1, split="dev", seed=0)
    path = goal_path(starts, 10, motion="circle", velocity=0.05)
    rollout = env.rollout(10)
    torch.testing.assert_close(rollout["next", keys.TARGET_POS], path[:, 1:])


def test_tables_and_plots_name_the_paper(tmp_path):
    rows = play({"corner": oracle(), "pursuit": TargetPursuit(TASK.static_planner())}).rows
    assert [row.paper_success for row in rows] == [0.618, None]
    assert [row.paper_success_solvable for row in rows] == [None, None]
    table = format_table(TASK, rows)
    assert "velocity 0.031 m per control step, motion straight" in table
    assert "62 %" in table
    more = [dataclasses.replace(row, settings=row.settings | {"velocity": 0.041}) for row in rows]
    plot_sweep(TASK, rows + more, "velocity", tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_other_settings_change_what_is_solved(found):
    near = play({"oracle": oracle()}, threshold=0.05)
    far = play({"oracle": oracle()}, goal_range=0.3)
    for name in ("solvable", "success"):
        usual, more, fewer = (getattr(one.outcomes["oracle"], name).sum() for one in (found, near, far))
        assert fewer < usual < more, name


def test_episodes_that_cannot_be_reached_are_no_success():
    class Nothing(torch.nn.Module):
        def forward(self, td):
            return td.set(keys.ACTION, torch.zeros(*td.batch_size, 4))

    truth = Truth(torch.zeros(4, 60, 3), torch.ones(4, dtype=torch.bool))
    settings = TASK.default_settings(velocity=0.1)
    outcome = run_episodes(Nothing(), TASK, settings, truth, episodes=4, num_envs=4, num_threads=1, progress=False)
    assert not outcome.success.any()
    assert outcome.steps.tolist() == [-1] * 4


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"planners": ["wait_and_drop"]}, "unknown planner of fetch_reach 'wait_and_drop'"),
        ({"static": "ik"}, "unknown static planner of fetch_reach 'ik'"),
        ({"velocity": 3.0}, r"velocity must be in \[0, 0.2\], got 3.0"),
        ({"friction": 1.0}, "unknown setting of fetch_reach 'friction'"),
        ({"motion": "zigzag"}, "unknown motion 'zigzag'"),
        ({"threshold": 0.0}, "threshold must be >= 1e-06"),
        ({"goal_range": -0.1}, "goal_range must be >= 0"),
    ],
)
def test_bad_settings_are_named(changes, named):
    with pytest.raises(InputError, match=named):
        play(**({"planners": ["pursuit"]} | changes))


def test_tasks_fill_in_their_own_names():
    assert TASK.default_static == "proportional"
    assert TASK.default_planners == ("pursuit", "corner", "oracle", "exact")
    assert sweepable(TASK) == ["velocity"]
    values = default_values(TASK, "velocity", "proportional", TASK.default_settings())
    assert values == [round(0.001 + 0.005 * step, 3) for step in range(11)]
    with pytest.raises(InputError, match=r"unknown task 'fetch_raech' .did you mean 'fetch_reach'"):
        evaluate("fetch_raech")
