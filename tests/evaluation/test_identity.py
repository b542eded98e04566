"""What a result is of: folders never hold two kinds, and what is damaged is refused by its place."""

import dataclasses
import json
import random
import re

import pytest
import torch

from tests.evaluation.toy_task import TASK, pull
from torchdyn_plan.errors import InputError, TorchdynPlanError
from torchdyn_plan.evaluation import evaluate, evaluation
from torchdyn_plan.evaluation import sweep as sweeps
from torchdyn_plan.evaluation.sweep import sweep
from torchdyn_plan.nets import Actor
from torchdyn_plan.planners import PolicyPlanner, TargetPursuit
from torchdyn_plan.planners.pretrained import planner_digest

QUIET = {"episodes": 4, "num_envs": 4, "num_threads": 1, "progress": False}
OTHERS = [
    ({"drift": 0.5}, r"drift is 0.01 there, 0.5 here"),
    ({"episodes": 5}, "episodes is 4 there, 5 here"),
    ({"seed": 1}, "seed is 0 there, 1 here"),
    ({"split": "dev"}, "split is 'test' there, 'dev' here"),
    ({"task": dataclasses.replace(TASK, digest=lambda: "drift-2"), "other_scene": True}, "scene is 'drift-1' there"),
    ({"planners": {"other": TargetPursuit(pull())}}, r"planners is \['mine'\] there"),
]


@pytest.fixture(autouse=True)
def no_plots(monkeypatch):
    monkeypatch.setattr(evaluation, "plot_results", lambda *_: None)
    monkeypatch.setattr(sweeps, "plot_sweep", lambda *_: None)


def actor(number):
    torch.manual_seed(number)
    return Actor(robot_state_size=3, tool_slice=(0, 3), action_size=3, hidden=4, layers=1)


def goes(number):
    """A planner with weights."""
    return TargetPursuit(PolicyPlanner(actor(number)), scene="drift-1")


def files(folder):
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def run(out, **changes):
    settings = {"task": TASK, "planners": {"mine": goes(0)}} | QUIET | changes
    return evaluate(settings.pop("task"), settings.pop("planners"), out=out, **settings)


def vary(out, **changes):
    settings = {"task": TASK, "planners": {"mine": goes(0)}, "over": "drift", "values": [0.0, 0.02], "repeats": 1}
    settings |= QUIET | changes
    return sweep(settings.pop("task"), settings.pop("planners"), out=out, **settings)


@pytest.mark.parametrize(
    ("changes", "message"), [*OTHERS, ({"planners": {"mine": goes(1)}}, "weights of mine is '.*' there, '.*' here")]
)
def test_an_evaluation_of_something_else_is_refused_before_it_runs(tmp_path, monkeypatch, changes, message):
    run(tmp_path)
    before = files(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(evaluation.Study, "run", lambda *_: pytest.fail("it ran"))
        with pytest.raises(InputError, match=f"holds an evaluation with another configuration: {message}"):
            run(tmp_path, **changes)
    assert files(tmp_path) == before
    run(tmp_path, overwrite=True, **changes)
    run(tmp_path, **changes)


def test_another_version_of_the_package_is_another_result(tmp_path):
    run(tmp_path)
    text = (tmp_path / "results.json").read_text()
    (tmp_path / "results.json").write_text(re.sub(r'"torchdyn-plan": "[^"]*"', '"torchdyn-plan": "0.0.1"', text))
    with pytest.raises(InputError, match=r"version is '0\.0\.1' there"):
        run(tmp_path)


@pytest.mark.parametrize(
    "changes", [{"planners": {"mine": goes(1)}}, {"task": dataclasses.replace(TASK, digest=lambda: "drift-2")}]
)
def test_points_of_other_weights_or_another_scene_are_not_mixed(tmp_path, changes):
    changes["other_scene"] = True
    vary(tmp_path, other_scene=True)
    with pytest.raises(InputError, match="holds a sweep with another configuration"):
        vary(tmp_path, **changes)
    own = vary(tmp_path, overwrite=True, **changes)
    assert len(own) == 2
    # A point that was carried over from another sweep is none of this one.
    vary(tmp_path / "other", other_scene=True)
    name = "points/drift-0.0-repeat-00.json"
    (tmp_path / name).write_bytes((tmp_path / "other" / name).read_bytes())
    with pytest.raises(InputError, match=r"drift-0.0-repeat-00.json' is damaged \(it is of another sweep"):
        vary(tmp_path, **changes)


def test_a_sweep_and_an_evaluation_never_take_each_others_folder(tmp_path):
    run(tmp_path / "one")
    vary(tmp_path / "two")
    before = files(tmp_path)
    with pytest.raises(InputError, match="holds an evaluation"):
        vary(tmp_path / "one")
    with pytest.raises(InputError, match="holds a sweep"):
        run(tmp_path / "two")
    found = run(tmp_path / "new")
    with pytest.raises(InputError, match="holds a sweep"):
        found.save(tmp_path / "two")
    assert {name: text for name, text in files(tmp_path).items() if "new" not in name.parts} == before
    (tmp_path / "two" / "mine.txt").write_text("a person's own")
    run(tmp_path / "two", overwrite=True)
    assert {file.name for file in (tmp_path / "two").iterdir()} == {"results.json", "episodes.json", "mine.txt"}


def test_points_without_a_word_of_what_they_are_of_are_refused(tmp_path):
    vary(tmp_path)
    (tmp_path / "sweep.json").unlink()
    (tmp_path / "results.json").unlink()
    with pytest.raises(InputError, match="holds points without a word of what they are of"):
        vary(tmp_path)


def test_planners_are_told_apart_by_their_weights_and_their_settings():
    assert planner_digest(goes(0)) == planner_digest(goes(0)) != planner_digest(goes(1))
    assert planner_digest(PolicyPlanner(actor(0), chunk=3)) != planner_digest(PolicyPlanner(actor(0), chunk=4))
    assert planner_digest(lambda tensordict: tensordict) is None


def damages():
    """Ways in which a file of JSON can be damaged, some drawn."""
    draw = random.Random(0)
    whole = [None, [], {}, 3, "text", True]
    yield from (lambda content, value=value: value for value in whole)

    def places(content, path=()):
        items = content.items() if isinstance(content, dict) else enumerate(content)
        for key, value in items:
            yield (*path, key)
            if isinstance(value, (dict, list)) and value:
                yield from places(value, (*path, key))

    def change(content, number):
        place = draw.choice(list(places(content)))
        at = content
        for key in place[:-1]:
            at = at[key]
        wrong = [None, float("nan"), 1e400, -7, 2**90, "x", [], {}, [None], {"a": 1}, True, 0.5, "DELETE", "REPEAT"]
        value = wrong[number % len(wrong)]
        if value == "DELETE":
            del at[place[-1]]
        elif value == "REPEAT" and isinstance(at[place[-1]], list):
            at[place[-1]] = at[place[-1]] * 2
        else:
            at[place[-1]] = value
        return content

    yield from (lambda content, number=number: change(content, number) for number in range(56))


def test_a_damaged_sweep_is_refused_by_name_or_ends_as_it_was(tmp_path):
    """No damage is a traceback, and none is believed: but for numbers that a run might have given."""
    vary(tmp_path)
    names = ["sweep.json", "points/drift-0.02-repeat-00.json"]
    kept = {name: (tmp_path / name).read_bytes() for name in names}
    believed, unclear = [], []
    for name in names:
        for number, damage in enumerate(damages()):
            changed = damage(json.loads(kept[name]))
            (tmp_path / name).write_text(json.dumps(changed))
            try:
                rows = vary(tmp_path)
            except TorchdynPlanError as error:
                unclear += [] if str(tmp_path) in str(error) else [str(error)]
            else:
                believed += [(number, name)] if changed != json.loads(kept[name]) else []
                assert all(row.episodes == 4 and 0 <= row.success <= 1 for row in rows)
            (tmp_path / name).write_bytes(kept[name])
    assert not unclear
    # Another number of steps, or of seconds, is what a run might have given; so is an evidence more or less.
    assert len(believed) <= 20, believed
    for text in (b"", b"{", kept[names[1]][:-30], b"\xff\xfe", b"[" * 100_000, b'{"a": ' * 100_000):
        for name in names:
            (tmp_path / name).write_bytes(text)
            with pytest.raises(InputError, match=name):
                vary(tmp_path)
            (tmp_path / name).write_bytes(kept[name])
