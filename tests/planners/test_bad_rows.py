"""A bad row never stops the others, and never moves blindly: every key that a shipped planner reads."""

import math

import pytest
import torch

from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.planners import DynamicPlanner, PlanStatus, TargetPursuit
from torchdyn_plan.tasks import load_task

ROW, STEPS = 1, 16
PLANNERS = {
    "corner, ik": ("corner", "ik"),
    "corner, rl": ("corner", "rl"),
    "wait and drop, ik": ("wait_and_drop", "ik"),
    "pursuit, ik": ("pursuit", "ik"),
    "pursuit, rl": ("pursuit", "rl"),
}
READ = ["tool_pos", "target_pos", "target_history", "robot_state", "joint_pos"]
VALUES = [math.nan, -math.inf, 3e38, 1e20]


@pytest.fixture(scope="module", params=PLANNERS.values(), ids=PLANNERS.keys())
def planner(request):
    # Blocks of always as many rows: a row does not depend on how many others plan at the same step.
    return load_task("trapper").planner(*request.param, chunk=4, static_chunk=4).requires_grad_(False)


@pytest.fixture(scope="module")
def moment(planner):
    """What the planner sees at the step of its first plan, and one that is between two."""
    env = TrapperEnv(3, seed=7, num_threads=1)
    td, found = env.reset(), []
    for step in range(STEPS):
        if step in (13, 15):
            found.append(td.clone())
        td = env.step_and_maybe_reset(planner(td))[1]
    return found


def spoiled(td, key, value):
    td = td.clone()
    td[key][ROW] = value
    return td


def reads(planner, key):
    return key in planner.in_keys


@pytest.mark.parametrize("which", [0, 1], ids=["plans", "between"])
@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("key", READ)
def test_a_bad_row_gets_no_action_and_the_others_do_not_notice(planner, moment, key, value, which):
    if not reads(planner, key):
        pytest.skip(f"does not read {key}")
    usual = planner(moment[which].clone())
    found = planner(spoiled(moment[which], key, value))
    for name in ("goal", "action", "arrival_steps"):
        assert torch.isfinite(found[name]).all(), name
        for row in (0, 2):
            assert torch.equal(found[name][row], usual[name][row]), name
    target = key.startswith("target")
    if not target or isinstance(planner, TargetPursuit):
        assert not found["action"][ROW].any()
    if isinstance(planner, DynamicPlanner):
        assert found["plan", "status"][ROW] == PlanStatus.BAD_INPUT
        assert torch.equal(found["plan", "status"][[0, 2]], usual["plan", "status"][[0, 2]])
        for name, entry in found["plan"].items():
            assert not entry.is_floating_point() or torch.isfinite(entry[[0, 2]]).all(), name
    assert torch.equal(found[key][ROW].isnan(), torch.full_like(found[key][ROW], math.isnan(value)).bool())


@pytest.mark.parametrize("key", ["tool_pos", "robot_state", "joint_pos", "target_pos"])
def test_a_row_that_begins_badly_recovers(planner, key):
    if not reads(planner, key):
        pytest.skip(f"does not read {key}")
    env = TrapperEnv(3, seed=7, num_threads=1)
    td, start = env.reset(), None
    for step in range(20):
        shown = spoiled(td, key, math.nan) if step < 4 else td
        acted = planner(shown)
        if step < 4 and key != "target_pos":
            assert not acted["action"][ROW].any()
        if step == 4 and isinstance(planner, DynamicPlanner) and not acted["plan", "replanned"][ROW]:
            # It holds the tool where it is, and does not go to where zeros would have been a goal.
            assert (acted["goal"][ROW] - td["tool_pos"][ROW]).norm() < 0.02
        td["action"] = acted["action"]
        if isinstance(planner, DynamicPlanner) or "plan" in acted:
            td["plan"] = acted["plan"]
        start = td["tool_pos"].clone() if start is None else start
        td = env.step_and_maybe_reset(td)[1]
    assert torch.isfinite(planner(td)["action"]).all()
    if isinstance(planner, DynamicPlanner):
        assert td["plan", "replans"][ROW] >= 1
    assert (td["tool_pos"] - start).norm(dim=-1)[ROW] > 1e-3


@pytest.mark.parametrize("name", ["goal", "path_pos", "path_goal", "path"])
def test_a_spoiled_memory_starts_afresh(planner, moment, name):
    td = moment[1].clone()
    if ("plan", name) not in planner.in_keys or not td["plan", name].numel():
        pytest.skip(f"does not remember {name}")
    usual = planner(td.clone())
    td["plan", name][ROW] = math.nan
    found = planner(td)
    again = planner(found.clone())
    for one in (found, again):
        assert torch.isfinite(one["action"]).all()
        assert torch.isfinite(one["goal"]).all()
    assert torch.equal(found["action"][[0, 2]], usual["action"][[0, 2]])
    assert all(torch.isfinite(value).all() for value in again["plan"].values() if value.is_floating_point())


def test_nothing_is_written_to_what_was_read(planner, moment):
    td = spoiled(moment[0], "target_pos", math.nan)
    before = td.clone()
    planner(td)
    for key, value in before.exclude("plan", "goal", "action", "arrival_steps").items():
        assert torch.equal(td[key].nan_to_num(7.0), value.nan_to_num(7.0)), key


def test_a_compiled_planner_judges_alike():
    planner = load_task("trapper").planner("corner", "ik").requires_grad_(False)
    env = TrapperEnv(3, seed=7, num_threads=1)
    td = planner(env.reset())
    td = spoiled(env.step_and_maybe_reset(td)[1], "joint_pos", math.nan)
    torch._dynamo.reset()
    compiled = torch.compile(planner, backend="eager", fullgraph=True)(td.clone())
    eager = planner(td.clone())
    assert not compiled["action"][ROW].any()
    assert torch.equal(compiled["action"], eager["action"])
