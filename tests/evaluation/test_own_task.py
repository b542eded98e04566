"""Evaluations from Python, of a person's own task and of a person's own planners."""

import json
import subprocess
import sys

import pytest
import torch

import torchdyn_plan
from tests.evaluation.toy_task import MAX_STEPS, NEAR, SPEED, TASK, pull
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.evaluation.sweep import sweep
from torchdyn_plan.planners import TargetPursuit

QUIET = {"episodes": 12, "num_envs": 5, "num_threads": 1, "progress": False}


def run_to(tensordict):
    """A planner as plain as can be: no class, no keys, no memory."""
    way = tensordict["target_pos"] - tensordict["tool_pos"]
    return tensordict.set("action", (way / SPEED).clamp(-1.0, 1.0))


def stay(tensordict):
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 3))


def test_a_persons_own_planners_play_a_persons_own_task(tmp_path):
    found = evaluate(TASK, {"mine": run_to, "lazy": stay}, drift=0.02, **QUIET)
    mine, lazy = found.rows
    assert (mine.planner, mine.task, mine.settings, mine.episodes) == ("mine", "drift", {"drift": 0.02}, 12)
    assert mine.success == 1.0 > lazy.success
    assert (mine.solvable, mine.failures) == (1.0, {})
    found.save(tmp_path)
    content = json.loads((tmp_path / "episodes.json").read_text())["mine"]
    assert list(content) == ["caught", "far", "solvable", "steps", "replans", "seconds"]
    table = found.table()
    assert "steps to catch" in table
    assert "drift 0.02 m a step" in table
    assert "solvable" not in table
    assert (tmp_path / "results.png").stat().st_size > 5_000


def test_success_counts_when_it_is_first_true_and_flags_at_the_end():
    outcome = evaluate(TASK, {"mine": run_to}, drift=0.06, **QUIET).outcomes["mine"]
    start = TASK.make_env(TASK.default_settings(drift=0.06), num_envs=12, split="test", seed=0).reset()["target_pos"]
    tool, target = torch.zeros(12, 3), start
    first = torch.full((12,), -1)
    for step in range(1, MAX_STEPS + 1):
        tool = tool + SPEED * ((target - tool) / SPEED).clamp(-1.0, 1.0)
        target = target + torch.tensor([0.06, 0.0, 0.0])
        near = (tool - target).norm(dim=-1) < NEAR
        first = torch.where((first < 0) & near, step, first)
    assert torch.equal(outcome.steps, first)
    assert torch.equal(outcome.success, first > 0)
    assert outcome.success.any()
    assert not outcome.success.all()
    # Points that were caught are lost again, as they drift faster than the robot runs: success stays.
    assert (outcome.success & ~near).any()
    assert torch.equal(outcome.flags["far"], (tool - target).norm(dim=-1) > 1.5)


def test_outcomes_do_not_depend_on_how_many_run_side_by_side():
    one, other = (evaluate(TASK, {"mine": run_to}, **(QUIET | {"num_envs": n})).outcomes["mine"] for n in (1, 12))
    assert torch.equal(one.steps, other.steps)


def test_the_tasks_own_planners_are_named():
    found = evaluate(TASK, **QUIET)
    assert list(found.outcomes) == ["pursuit"]
    assert found.config["static"] == "pull"
    assert evaluate(TASK, ["pursuit"], **QUIET).rows[0].success == found.rows[0].success


def test_a_planner_of_another_scene_is_refused():
    stranger = TargetPursuit(pull(), scene="drift-2")
    with pytest.raises(InputError, match=r"planner 'mine' belongs to another scene \(drift-2\) than drift \(drift-1\)"):
        evaluate(TASK, {"mine": stranger}, **QUIET)
    assert evaluate(TASK, {"mine": stranger}, other_scene=True, **QUIET).rows[0].success == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"planners": ["persuit"]}, "unknown planner of drift 'persuit' .did you mean 'pursuit'"),
        ({"planners": {}}, "planners must name at least one of pursuit"),
        ({"planners": ["pursuit", "pursuit"]}, "planners must be named once each, got pursuit pursuit"),
        ({"planners": {"mine": run_to}, "weights": "here"}, "weights apply to planners given by name"),
        ({"static": "push"}, "unknown static planner of drift 'push'"),
        ({"drift": 2.0}, r"drift must be in \[0, 1\], got 2.0"),
        ({"speed": 2.0}, "unknown setting of drift 'speed'"),
        ({"episodes": 0}, "episodes must be >= 1"),
        ({"num_envs": 0}, "num_envs must be >= 1"),
        ({"num_threads": -1}, "num_threads must be >= 0"),
        ({"seed": -1}, "seed must be >= 0"),
        ({"split": "train"}, "unknown split 'train'"),
    ],
)
def test_a_mistake_is_named(changes, message):
    with pytest.raises(InputError, match=message):
        evaluate(TASK, **(QUIET | changes))


def test_a_sweep_runs_over_any_setting_that_has_values(tmp_path):
    rows = sweep(TASK, {"mine": run_to}, over="drift", out=tmp_path, repeats=2, **QUIET)
    assert [(row.settings["drift"], row.episodes) for row in rows] == [(0.0, 24), (0.02, 24), (0.1, 24)]
    assert rows[0].success == 1.0 > rows[-1].success
    whole = evaluate(TASK, {"mine": run_to}, drift=0.1, seed=1, **QUIET).outcomes["mine"]
    kept = json.loads((tmp_path / "points" / "drift-0.1-repeat-01.json").read_text())["planners"]["mine"]
    assert kept["steps"] == whole.steps.tolist()
    assert (tmp_path / "sweep.png").stat().st_size > 5_000
    with pytest.raises(InputError, match="unknown setting of drift to sweep over 'speed'"):
        sweep(TASK, over="speed", out=tmp_path)


def test_importing_the_package_imports_nothing_else():
    script = "import sys; before = set(sys.modules); import torchdyn_plan; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "__future__ torchdyn_plan torchdyn_plan.lazy\n"


def test_a_package_inside_is_there_without_an_import_of_its_own():
    script = "import torchdyn_plan; print(torchdyn_plan.kinematics.__name__, 'torch' in vars(torchdyn_plan))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "torchdyn_plan.kinematics False\n"


def test_the_package_has_one_face():
    for name in torchdyn_plan.__all__:
        assert getattr(torchdyn_plan, name) is not None
        assert name in dir(torchdyn_plan)
    assert torchdyn_plan.evaluate is evaluate
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = torchdyn_plan.nothing
