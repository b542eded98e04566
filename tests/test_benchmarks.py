"""Every script in ``benchmarks`` runs, on next to nothing, and writes what it measured beside versions and machine."""

import importlib
import importlib.util
import json
import shutil
from pathlib import Path

import pytest

import torchdyn_plan
from tests.scripts import run
from torchdyn_plan.errors import InputError
from torchdyn_plan.tasks import load_task

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
WEIGHTS = Path(torchdyn_plan.__file__).parent / "weights"
SMALL = {
    "ablation": "--velocities 5 --episodes 2 --num-envs 2 --split dev",
    "braking": "--episodes 2 --num-envs 2 --threads 1",
    "arrival_time": "--batches 2 --cases 3 --seconds 0.01",
    "chase": "--rows 8",
    "catch": "--episodes 2 --sensors exact --planners pursuit --split dev",
    "conveyor": "--episodes 2 --speeds 0.6 --planners pursuit:gain",
    "calibration": "--episodes 8 --pursuit-episodes 8 --split dev",
    "ceiling": "--velocities 5 --episodes 3 --spacing 60 --meetings 1 --leads 7 --rows 64 --split dev",
    "count_calls": "--planners corner --batch 2",
    "diagnose": "--velocities 3 --episodes 4 --arrivals network --split dev",
    "final": "--rehearse --velocities 5 --planners untrained --episodes 2 --num-envs 2",
    "following": "--arms ur5 --paths 2 --steps 6",
    "forecast_gain": "--episodes 2 --seeds 0 --velocity 5",
    "former_latency": "--former . --planners corner --statics ik --processes 1 --rounds 1 --seconds 0.01 --calls plan",
    "inverse": "--arms ur5 --poses 4 --repeats 1",
    "kinematics_beside": "--former . --batches 1 --seconds 0.01 --no-compiled --no-rivals --repeats 1",
    "joint_speeds": "--episodes 4 --num-envs 4",
    "loops": "--planners corner --episodes 4 --steps 30 --loops rollout",
    "noisy_replan": "--batches 1 --blocks 1 --seconds 0.01",
    "latency": "--velocities 5 --episodes 2 --latencies 0 20 --not-compensated 20",
    "reach_at_rest": "--episodes 4 --threads 1",
    "reach_ceiling": "--velocities 0.03 --episodes 8 --other-velocities 0.03 --other-episodes 8 --bounds-alone",
    "reach_env": "--copies 2 --steps 4 --threads 1",
    "recovery": "--planners wait_and_drop --statics ik --velocities 5 --episodes 2 --num-envs 2 --split dev",
    "schedules": "--planners wait_and_drop --velocities 3 --schedules paper --episodes 4",
    "sensors": "--sensors exact --velocities 5 --episodes 2 --num-envs 2 --planners untrained --tracks kalman",
    "static_task": "--episodes 8 --split dev",
    "worst_case": "--planners corner --statics ik --calls 40 --seconds 1",
    "track": "--batches 1 2 --seconds 0.01",
    "view": "--shown chase:pursuit --seconds 0.5",
}
ELSEWHERE = {
    "air_hockey",
    "descriptions",
    "deviations",
    "drive_page",
    "measure_arrivals",
    "nearest",
    "paper_scene",
    "policy_curves",
    "sensor_curves",
    "policy_peers",
    "same_episodes",
    "trainings",
}
"""Minutes at the least, another environment, files of other packages, a picture of trainings, what the package's own
arrival map is made by, a browser, a comparison of files, or networks of several trainings, which have a test of their
own."""
PARTS = {
    "air_hockey_agent",
    "air_hockey_defend",
    "air_hockey_hit",
    "air_hockey_side",
    "arms",
    "former_latency_side",
    "sides",
    "study",
}
"""No scripts of their own."""


LONG = {
    "noisy_replan",
    "ablation",
    "braking",
    "calibration",
    "final",
    "following",
    "forecast_gain",
    "former_latency",
    "inverse",
    "kinematics_beside",
    "latency",
    "worst_case",
}
"""Five to twenty seconds each: `make check` runs them; those that `make test` runs use the same harness."""


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in SMALL])
def test_benchmark_runs(name, tmp_path):
    if name.startswith("reach") and importlib.util.find_spec("gymnasium_robotics") is None:
        pytest.skip("gymnasium-robotics has the arm")
    if name == "view":
        pytest.importorskip("mjviser")
    out = tmp_path / "figures.json"
    words = [*SMALL[name].split(), "--out", out]
    ran = run(BENCHMARKS / f"{name}.py", *words, cwd=BENCHMARKS.parent, OMP_NUM_THREADS="1", PATH="")
    assert ran.returncode == 0, ran.stderr
    figures = json.loads(out.read_text())
    assert figures.keys() >= {"machine", "versions"}
    assert len(figures["rows"]) > 0


@pytest.fixture
def study(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("study")


def test_a_planning_step_goes_through_few_calls_in_few_files(study):
    count_calls = importlib.import_module("count_calls")
    followed = dict(count_calls.acts(load_task("trapper"), ["wait_and_drop"], batch=2))
    plans = count_calls.count(followed["wait_and_drop, a step that plans"])
    between = count_calls.count(followed["wait_and_drop, a step between plans"])
    assert 40 < plans["calls"] <= 60, plans
    assert plans["files"] <= 12, plans
    assert 20 < between["calls"] <= 31, between


TORTURE = {
    "bad_rows": 66,
    "bad_actions": 4,
    "mistakes": 30,
    "inverse": 64,
    "weight_files": 40,
    "state_files": 12,
    "training_data": 20,
    "identity": 20,
    "folders": 12,
}
"""Fewest cases of each promise that is tried in its own process, at a hundredth of the size."""


def torture(*words):
    module = "import runpy, sys\nsys.path.insert(0, '')\n"
    module += "runpy.run_module('benchmarks.torture', run_name='__main__', alter_sys=True)"
    return run(module, *words, cwd=BENCHMARKS.parent, timeout=500, OMP_NUM_THREADS="1")


def test_promises_are_tried_and_a_killed_run_goes_on(tmp_path):
    out = tmp_path / "torture.json"
    done = torture("--promises", *TORTURE, "--size", "0.01", "--out", str(out))
    assert done.returncode == 0, done.stdout + done.stderr
    content = json.loads(out.read_text())
    assert content.keys() >= {"machine", "versions", "config", "total"}
    assert {row["promise"]: row["faults"] for row in content["rows"]} == dict.fromkeys(TORTURE, 0)
    assert all(row["cases"] >= TORTURE[row["promise"]] for row in content["rows"])
    before = out.stat().st_mtime_ns
    again = torture("--promises", *TORTURE, "--size", "0.01", "--out", str(out))
    assert (again.returncode, out.stat().st_mtime_ns) == (0, before)
    assert "| a bad row never stops or changes the others" in again.stdout
    other = torture("--promises", "inverse", "--size", "0.02", "--out", str(out))
    assert "give another file" in other.stderr


def test_a_broken_promise_is_told(monkeypatch, tmp_path):
    import random

    from benchmarks.torture import bad_actions

    monkeypatch.setattr(bad_actions, "_differing", lambda *_: "it moved")
    found = bad_actions.PROMISE.run(random.Random(0), tmp_path, 0.001)
    assert found == {"cases": 2, "faults": 2, "told": ["it moved"] * 2, "seconds": found["seconds"]}


def test_no_promise_is_forgotten():
    from benchmarks.torture.__main__ import PROMISES

    shared = {"__init__", "__main__", "promise", "forked", "damage", "commands_in_small"}
    assert {file.stem for file in (BENCHMARKS / "torture").glob("*.py")} - shared == set(PROMISES)


def test_a_killed_study_goes_on_with_the_rows_in_its_file(study, tmp_path):
    arguments, measured = study.Output(out=tmp_path / "figures.json"), []

    def measure():
        measured.append(0)
        return {"value": float("nan"), "lost": [1]}

    for case in (1, 2, 1):
        study.Study(arguments, scene="here").row({"case": case}, measure)
    assert len(measured) == 2
    content = json.loads(arguments.out.read_text())
    assert content["rows"] == [{"case": case, "value": None, "lost": [1]} for case in (1, 2)]
    assert content.keys() == {"machine", "versions", "scene", "config", "rows"}
    with pytest.raises(SystemExit, match="holds rows of the scene here, not of there"):
        study.Study(arguments, scene="there")
    assert study.Study(arguments, scene="there", resume=False).rows == []
    former = content | {"versions": content["versions"] | {"torchdyn-plan": "0.0.9"}}
    arguments.out.write_text(json.dumps(former))
    with pytest.raises(SystemExit, match=r"holds rows of version 0\.0\.9, not of"):
        study.Study(arguments, scene="here")


def test_a_row_is_saved_before_it_is_printed(study, tmp_path, monkeypatch):
    arguments = study.Output(out=tmp_path / "figures.json")

    def closed(*_):
        raise BrokenPipeError

    monkeypatch.setattr(study.tqdm, "write", closed)
    with pytest.raises(BrokenPipeError):
        study.Study(arguments).row({"case": 1}, dict)
    assert json.loads(arguments.out.read_text())["rows"] == [{"case": 1}]


def test_changes_are_paired(study):
    before, after = ({"solvable": 10, "lost": lost} for lost in ([1, 2, 3], [2, 7]))
    assert study.change_entries(before, after)["change"] == pytest.approx(0.1)
    low, high = study.change_entries(before, after)["change_ci"]
    assert low < 0.1 < high
    assert study.change_entries(before, before)["change"] == 0.0
    # One episode lost and two won: 2 (1 + 3) / 2³.
    assert study.change_entries(before, after)["change_p"] == 1.0
    many = {"solvable": 100, "lost": list(range(10))}
    assert study.change_entries(many, many | {"lost": [0]})["change_p"] == pytest.approx(2 / 2**9)


@pytest.fixture
def final(study):
    return importlib.import_module("final")


def test_a_release_plays_a_series_of_its_own_from_a_commit(final):
    one, other = (final.of_release(final.Arguments(), release, "0123456789ab") for release in ("1.0.0", "1.0.1"))
    assert (one.split, one.episodes, one.out.name) == ("final", 1000, "final-1.0.0.json")
    assert one.seed != other.seed
    for commit in (None, "0123456789ab-dirty"):
        with pytest.raises(SystemExit, match="commit the changes first"):
            final.of_release(final.Arguments(), "1.0.0", commit)
    for changed in ({"episodes": 10}, {"out": Path("elsewhere.json")}, {"seed": 1}, {"velocities": (3.0,)}):
        with pytest.raises(SystemExit, match="what it always plays"):
            final.of_release(final.Arguments(**changed), "1.0.0", "0123456789ab")


def test_a_release_is_opened_once(study, final, tmp_path):
    arguments = study.Output(out=tmp_path / "final.json")
    opening = {"release": "1.0.0", "commit": "0123456789ab", "planners": {"corner": "00ff"}, "seed": 7}
    final.open_release(study.Study(arguments), opening, 2)
    assert json.loads(arguments.out.read_text())["rows"] == [opening]
    # A run that was killed goes on.
    begun = study.Study(arguments)
    final.open_release(begun, opening, 2)
    begun.add({"success": 1.0})
    with pytest.raises(SystemExit, match=r"opened before with other planners or commit, see .*final\.json"):
        final.open_release(study.Study(arguments), opening | {"planners": {"corner": "00fe"}}, 2)
    begun.add({"success": 0.5})
    with pytest.raises(SystemExit, match=r"its figures are in .*final\.json"):
        final.open_release(study.Study(arguments), opening, 2)


def test_no_other_study_plays_the_split_of_releases(study, final):
    with pytest.raises(InputError, match="split 'final' is played once a release"):
        study.Episodes(split="final")
    with pytest.raises(InputError, match="split 'final' is played once a release"):
        final.main(final.Arguments(split="final", rehearse=True))


@pytest.mark.slow
def test_trainings_are_put_together(study, tmp_path):
    trainings = importlib.import_module("trainings")
    shipped = {"forecaster": "forecaster-trapper", "spread": "spread-trapper", "eta": "eta-trapper-ik"}
    folders = tmp_path / "0", tmp_path / "1"
    for folder in folders:
        folder.mkdir()
        for kind, name in shipped.items():
            shutil.copy(WEIGHTS / f"{name}.safetensors", folder / f"{kind}.safetensors")
    arguments = trainings.Arguments(
        weights=folders, velocities=(1.0, 5.0), episodes=2, num_envs=2, threads=1, out=tmp_path / "figures.json"
    )
    trainings.main(arguments)
    written = json.loads(arguments.out.read_text())["rows"]
    trainings.main(arguments)
    assert json.loads(arguments.out.read_text())["rows"] == written
    *rows, slow, fast, whole = written
    assert [(row["weights"], row["velocity"]) for row in rows] == [
        (str(folder), velocity) for folder in folders for velocity in (1.0, 5.0)
    ]
    assert slow["interquartile_mean"] == rows[0]["success_solvable"]
    assert fast["interquartile_mean"] == rows[1]["success_solvable"]
    assert whole["trainings"] == 2
    assert whole["interquartile_mean"] == pytest.approx((slow["interquartile_mean"] + fast["interquartile_mean"]) / 2)


def test_the_mean_over_trainings_leaves_out_a_failed_one(study):
    trainings = importlib.import_module("trainings")
    rows = [[{"success_solvable": value}] for value in (0.9, 0.91, 0.92, 0.1)]
    found = trainings.over_trainings(rows)
    assert found["interquartile_mean"] == pytest.approx(0.905)
    assert found["trainings"] == 4


def test_no_benchmark_is_forgotten():
    assert {file.stem for file in BENCHMARKS.glob("*.py")} == SMALL.keys() | ELSEWHERE | PARTS
