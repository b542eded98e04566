import math

import pytest
import torch

from tests.evaluation.untrained import untrained
from torchdyn_plan.cli_arguments import CONTROL_STEP_MS, EvaluateArguments
from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.evaluation import run
from torchdyn_plan.evaluation.latency import delay_plans
from torchdyn_plan.planners import CallablePlanner, IKPlanner, ReplanSchedule, TargetPursuit

SCHEDULE = ReplanSchedule(first_step=3, window=7, minimum=5)


def goals(planner, steps=16):
    with torch.no_grad():
        return TrapperEnv(2, num_threads=1).rollout(steps, planner, break_when_any_done=False)["goal"]


@pytest.mark.parametrize("told", [True, False])
def test_plans_come_late_and_only_who_is_told_plans_for_it(told):
    plain, late = untrained(schedule=SCHEDULE), delay_plans(untrained(schedule=SCHEDULE), 2, told=told)
    assert late.latency == (2 if told else 0)
    expected, got = goals(plain), goals(late)
    assert torch.equal(got[:, :5], expected[:, :1].expand(-1, 5, -1))
    assert not torch.equal(got[:, 5], got[:, 4])
    if not told:
        assert torch.equal(got[:, 5], expected[:, 3])


def test_no_latency_and_planners_that_plan_nothing_are_left_alone():
    planner = untrained()
    assert delay_plans(planner, 0, told=True).delivery is planner.delivery
    pursuit = TargetPursuit(IKPlanner())
    assert delay_plans(pursuit, 5, told=True) is pursuit


def test_a_control_step_is_the_scenes():
    assert math.isclose(CONTROL_STEP_MS / 1000, TrapperScene().control_step)
    assert EvaluateArguments(latency_ms=36).latency_steps == 9


def test_evaluate_delays_the_planners_that_it_runs(monkeypatch):
    still = CallablePlanner(lambda state, goal: torch.zeros(*goal.shape[:-1], 6))
    planner = untrained()
    planner.static = still
    monkeypatch.setitem(run.PLANNERS, "corner", lambda static, task: planner)
    monkeypatch.setattr(run, "record_truth", lambda arguments: (torch.zeros(1, 9, 3), torch.ones(1, dtype=torch.bool)))
    monkeypatch.setattr(run, "run_episodes", lambda planner, *others: (planner.latency, planner.delivery.steps))
    for compensate in (True, False):
        arguments = EvaluateArguments(planners=("corner",), latency_ms=20, compensate=compensate)
        assert run.run_points(arguments) == {"corner": (5 if compensate else 0, 5)}
