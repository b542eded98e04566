import re
from dataclasses import replace

import pytest

from tests.bench import own
from torchdyn_plan.bench.chosen import Source
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import DynamicPlanner, IKPlanner
from torchdyn_plan.tasks import load_task

TASK = load_task("trapper")


def test_default_planners_are_those_of_the_task_that_plan_on_what_is_seen():
    made = Source(task=TASK).choose(None)
    assert list(made) == ["wait", "corner", "exact", "exact, coarse to fine", "wait_and_drop"]
    assert made["exact, coarse to fine"].planner.search.coarse == 4
    assert {one.task.name for one in made.values()} == {"trapper"}
    alone = replace(TASK, planners={"pursuit": TASK.planners["pursuit"]})
    with pytest.raises(InputError, match="no default planner of trapper"):
        Source(task=alone).choose(None)


def test_a_planner_is_found_by_name_in_a_folder_or_at_a_place(tmp_path):
    TASK.planner("exact").save_pretrained(tmp_path / "mine")
    names = [
        "corner",
        "ik",
        "trapper-rl",
        str(tmp_path / "mine"),
        "tests.bench.own:PLANNER",
        "tests.bench.own:stand_on_tensordict",
    ]
    found = Source().choose(names)
    assert list(found) == names
    planners = [one.planner for one in found.values()]
    assert isinstance(planners[1], IKPlanner)
    assert planners[2].static.__class__.__name__ == "PolicyPlanner"
    assert planners[3].search == TASK.planner("exact").search
    assert planners[4] is own.PLANNER
    assert planners[5] is own.stand_on_tensordict
    assert Source().choose("corner").keys() == {"corner"}
    assert Source().choose(own.PLANNER)["planner"].planner is own.PLANNER
    assert Source().choose({"a": own.PLANNER, "b": own.stand_on_tensordict})["b"].planner is own.stand_on_tensordict


def test_a_place_may_make_a_planner_of_nothing(monkeypatch):
    monkeypatch.setattr(own, "make", lambda: own.PLANNER, raising=False)
    assert Source().choose("tests.bench.own:make")["tests.bench.own:make"].planner is own.PLANNER


def test_named_planners_are_built_on_the_static_planner_that_is_named(tmp_path):
    assert Source(static="rl").choose("corner")["corner"].planner.static.__class__.__name__ == "PolicyPlanner"
    with pytest.raises(Exception, match="no weights"):
        Source(weights=tmp_path / "none").choose("corner")


def test_a_planner_acts_in_the_task_that_it_belongs_to_unless_another_is_asked_for():
    pytest.importorskip("gymnasium_robotics")
    reach = DynamicPlanner.from_pretrained("fetch_reach-proportional")
    found = Source().choose({"reach": reach, "corner": TASK.planner("corner"), "own": own.PLANNER})
    assert [one.task.name for one in found.values()] == ["fetch_reach", "trapper", "trapper"]
    assert Source(task=TASK).choose(reach)["planner"].task is TASK
    assert Source().choose("fetch_reach-rl")["fetch_reach-rl"].task.name == "fetch_reach"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "name at least one planner"),
        ([], "name at least one planner"),
        (3, "'planner' is int"),
        ({"number": 3}, "'number' is int"),
        (IKPlanner, "'planner' is the class IKPlanner"),
        ([own.PLANNER], "must be names, or a mapping of names to planners, got DynamicPlanner"),
        (["corner", "corner"], "planners must be named once each, got corner corner"),
        ("corne", "unknown planner of trapper 'corne' (did you mean 'corner'?)"),
        ("tests.bench.own:NOTHING", "no planner at 'tests.bench.own:NOTHING'"),
        ("tests.bench.own:NO_PLANNER", "'tests.bench.own:NO_PLANNER' is TensorDict"),
        (TASK, "a planner is wanted, got the task trapper: give it as task='trapper'"),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else type(value).__name__,
)
def test_what_is_no_planner_is_named(given, message):
    with pytest.raises(InputError, match=re.escape(message)):
        Source().choose(given)


def test_a_folder_without_a_planner_is_named(tmp_path):
    with pytest.raises(InputError, match="holds no planner"):
        Source().choose(str(tmp_path))
