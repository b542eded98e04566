import math

import pytest
import torch

from tests.evaluation.untrained import untrained
from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.evaluation.study import Study
from torchdyn_plan.planners import Delayed, ReplanSchedule, TargetPursuit
from torchdyn_plan.tasks.trapper.task import TASK, ik_planner

SCHEDULE = ReplanSchedule(first_step=3, window=7, minimum=5)


def goals(planner, steps=16):
    with torch.no_grad():
        return TrapperEnv(2, seed=0, num_threads=1).rollout(steps, planner, break_when_any_done=False)["goal"]


def delivered(planner, delivery):
    return Study.of(TASK, {"mine": planner}, delivery=delivery).planners["mine"]


@pytest.mark.parametrize("compensate", [True, False])
def test_plans_come_late_and_only_who_is_told_plans_for_it(compensate):
    plain = untrained(schedule=SCHEDULE)
    late = delivered(plain, Delayed(2, compensate=compensate))
    assert late.delivery.delay == (2 if compensate else 0)
    expected, got = goals(plain), goals(late)
    assert torch.equal(got[:, :5], expected[:, :1].expand(-1, 5, -1))
    assert not torch.equal(got[:, 5], got[:, 4])
    if not compensate:
        assert torch.equal(got[:, 5], expected[:, 3])


def test_no_latency_and_planners_that_plan_nothing_are_left_alone():
    planner = untrained()
    assert delivered(planner, None) is planner
    pursuit = TargetPursuit(ik_planner())
    assert delivered(pursuit, Delayed(5)) is pursuit


def test_a_control_step_is_the_scenes():
    assert math.isclose(TASK.control_step, TrapperScene().control_step)


@pytest.mark.parametrize("compensate", [True, False])
def test_planners_that_are_named_are_delayed_too(compensate):
    delivery = Delayed(5, compensate=compensate)
    study = Study.of(TASK, ["corner", "pursuit"], delivery=delivery)
    assert study.planners["corner"].delivery == delivery
    assert study.config()["delivery"] == f"Delayed(steps=5, compensate={compensate})"
