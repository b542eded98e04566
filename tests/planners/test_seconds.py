"""Times in seconds are the control steps that they take."""

import pytest

from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import Background, Delayed, ReplanSchedule
from torchdyn_plan.planners.seconds import steps_in


@pytest.mark.parametrize(
    ("seconds", "control_step", "steps"),
    [(0.02, 0.004, 5), (0.3, 0.1, 3), (0.021, 0.004, 6), (0.0, 0.004, 0), (1e-9, 1.0, 0)],
)
def test_a_time_is_rounded_up_to_whole_steps(seconds, control_step, steps):
    assert steps_in("latency", seconds, control_step) == steps


def test_schedules_and_deliveries_take_seconds():
    schedule = ReplanSchedule.every_seconds(0.02, control_step=0.004, first=0.052)
    assert schedule == ReplanSchedule.every(5, first_step=13)
    assert ReplanSchedule.every_seconds(0.001, control_step=0.004) == ReplanSchedule.every(1)
    assert Delayed.by_seconds(0.02, control_step=0.01, compensate=False) == Delayed(2, compensate=False)
    background = Background.by_seconds(latency=0.008, deadline=0.03, control_step=0.004)
    assert (background.delay, background.deadline) == (2, 8)
    background.close()


@pytest.mark.parametrize(
    ("seconds", "control_step", "named"),
    [(-0.1, 0.004, "latency"), (float("nan"), 0.004, "latency"), (0.1, 0.0, "control_step")],
)
def test_what_is_no_time_is_named(seconds, control_step, named):
    with pytest.raises(InputError, match=named):
        Delayed.by_seconds(seconds, control_step=control_step)
