"""What is wrong with a tensordict is said in one sentence of the project's own, whatever a planner is made of."""

import pytest
import torch

from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import CallablePlanner, DynamicPlanner, TargetPursuit
from torchdyn_plan.tasks import load_task

PLANNERS = [("corner", "ik"), ("wait_and_drop", "ik"), ("wait_and_drop", "rl"), ("pursuit", "ik"), ("pursuit", "rl")]
CHANGES = {
    "one entry less": lambda value: value[..., :-1],
    "twice": lambda value: torch.cat([value, value], -1),
    "an axis at the end": lambda value: value.unsqueeze(-1),
    "an axis in the middle": lambda value: value.unsqueeze(1),
    "an axis less": lambda value: value[..., 0],
    "complex": lambda value: value.to(torch.complex64),
}
KEYS = ["joint_pos", "robot_state", "tool_pos", "target_pos", "target_history"]


@pytest.fixture(scope="module", params=PLANNERS, ids=", ".join)
def planner(request):
    return load_task("trapper").planner(*request.param)


@pytest.fixture
def seen():
    td = TrapperEnv(4, seed=7, num_threads=1).reset()
    td["step_count"] += 13
    return td


@pytest.mark.filterwarnings("ignore:the planner's memory is missing")
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
@pytest.mark.parametrize("key", KEYS)
def test_a_wrong_entry_is_named(planner, seen, key, change):
    if key not in planner.in_keys:
        pytest.skip(f"does not read {key}")
    seen[key] = change(seen[key])
    if change is CHANGES["complex"] and key in ("joint_pos", "robot_state"):
        pytest.skip("a complex number without an imaginary part may be taken")
    # The static planner calls the target that is pursued its goal.
    names = f"{key}|{key.removeprefix('target_')}|goal"
    with pytest.raises(InputError, match=names):
        planner(seen)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda td: td.lock_(), "writes to its tensordict, and this one is locked: give it a copy"),
        (lambda td: td.memmap_(), "this one is locked"),
        (lambda td: [td], "reads and writes a tensordict, got list"),
        (lambda td: None, "reads and writes a tensordict, got NoneType"),
        (lambda td: dict(td.items()), "reads and writes a tensordict, got dict"),
    ],
    ids=["locked", "memmap", "list", "None", "dict"],
)
def test_what_is_no_tensordict_to_write_to_is_named(planner, seen, spoil, says):
    with pytest.raises(InputError, match=says):
        planner(spoil(seen))


def test_an_error_of_a_persons_own_function_stays_his(seen):
    def broken(state, goal):
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        TargetPursuit(CallablePlanner(broken))(seen)


def test_the_cause_is_kept(seen):
    with pytest.raises(InputError) as caught:
        DynamicPlanner.from_pretrained("trapper-ik")(seen.lock_())
    assert isinstance(caught.value.__cause__, RuntimeError)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("usable", lambda value: value.double(), r"\('plan', 'usable'\) must hold true or false, got torch.float64"),
        (
            "countdown",
            lambda value: value.to(torch.complex64),
            "'countdown'\\) must hold whole numbers, got torch",
        ),
        ("goal", lambda value: value.to_sparse(), "'goal'\\) must hold floating-point numbers, got torch.sparse_coo"),
        ("goal", lambda value: "here", "'goal'\\) must hold floating-point numbers, got NonTensorData"),
        ("path_pos", lambda value: value[..., :-1], r"'path_pos'\) must have shape \(4, 6\), got \(4, 5\)"),
        ("path_pos", lambda value: value[..., 0], r"'path_pos'\) must have shape \(4, 6\), got \(4,\)"),
    ],
)
def test_a_memory_that_was_changed_is_named(seen, name, change, says):
    planner = load_task("trapper").planner("exact", "ik")
    seen = planner(seen)
    seen["step_count"] += 1
    seen["plan", name] = change(seen["plan", name])
    with pytest.raises(InputError, match=says):
        planner(seen)


@pytest.mark.filterwarnings("ignore:the planner's memory is missing")
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda td: td.to("meta"), "must be a tensor that holds numbers, got on no device, torch.float32"),
        (lambda td: td.set("step_count", "now"), "step_count must be a tensor that holds numbers, got NonTensorData"),
        (
            lambda td: td.exclude("plan").set("plan", torch.zeros(4, 1)),
            "plan must be a tensordict, a planner's memory",
        ),
    ],
    ids=["meta", "text", "plan"],
)
def test_what_holds_no_numbers_is_named(seen, change, says):
    with pytest.raises(InputError, match=says):
        load_task("trapper").planner("corner", "ik")(change(seen))
