"""Every planner that the command line names can be made with the weights that ship."""

import pytest

from torchdyn_plan.cli_arguments import TASKS
from torchdyn_plan.evaluation.planners import PLANNERS
from torchdyn_plan.planners import STATIC_PLANNERS

CASES = [
    (task, static, planner)
    for task, choices in TASKS.items()
    for static in choices.statics
    for planner in choices.planners
    if (task, static) != ("reach", "rl")
]


@pytest.mark.parametrize(("task", "static", "planner"), CASES)
def test_planner_by_name(task, static, planner):
    made = PLANNERS[planner](static, task)
    assert "action" in made.out_keys
    assert isinstance(made.static, type(STATIC_PLANNERS[task][static]()))
