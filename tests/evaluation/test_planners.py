"""Every planner that a shipped task names can be made with the weights that ship, and belongs to the task's scene."""

import importlib.util

import pytest

from torchdyn_plan.evaluation.study import Study
from torchdyn_plan.tasks import load_task

TASKS = [load_task("trapper"), load_task("fetch_reach")]
CASES = [(task, static, planner) for task in TASKS for static in task.static_planners for planner in task.planners]


@pytest.mark.parametrize(("task", "static", "planner"), CASES, ids=lambda one: getattr(one, "name", one))
def test_planner_by_name(task, static, planner):
    if task.name == "fetch_reach" and importlib.util.find_spec("gymnasium_robotics") is None:
        pytest.skip("gymnasium-robotics has the arm")
    made = Study.of(task, [planner], static=static).planners[planner]
    assert "action" in made.out_keys
    assert made.scene == task.digest()
    if planner not in task.rivals:
        assert isinstance(made.static, type(task.static_planner(static)))
