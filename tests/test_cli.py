import dataclasses
import json
import os
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from tests.scripts import run
from torchdyn_plan import cli, tasks
from torchdyn_plan.cli.output import say
from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.evaluation.results import NO_CAUSE, EpisodeOutcomes
from torchdyn_plan.evaluation.study import Study
from torchdyn_plan.nets import pretrained
from torchdyn_plan.tasks.trapper import solvable
from torchdyn_plan.tasks.trapper.solvable import ArrivalMap
from torchdyn_plan.tasks.trapper.task import TASK

ROOT = Path(__file__).parent.parent
ROW = {
    "planner",
    "static",
    "task",
    "track",
    "settings",
    "episodes",
    "success",
    "success_ci",
    "solvable",
    "success_solvable",
    "success_solvable_ci",
    "steps_to_success",
    "replans",
    "failures",
    "measures",
    "episodes_per_second",
    "paper_success",
    "paper_success_solvable",
    "repeats",
    "success_repeats",
    "success_solvable_repeats",
}
HEAVY = ("torch", "tensordict", "torchrl", "mujoco", "matplotlib", "numpy", "pytorch_kinematics")
COMMANDS = ("evaluate", "sweep", "report", "collect", "bench", "view", "record")


def answer(words, capsys):
    """Exit code of ``torchdyn-plan words``, what it printed and what it complained."""
    code = 0
    try:
        cli.main([str(word) for word in words])
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    return code, out, err


def helped(words, capsys):
    """What ``--help`` shows, in one line."""
    code, out, _ = answer([*words, "--help"], capsys)
    assert code == 0
    return " ".join(out.replace("│", " ").split())


@pytest.mark.parametrize(
    "words",
    [
        [],
        *([command] for command in COMMANDS),
        ["evaluate", "--task", "fetch_reach"],
        ["train"],
        ["train", "forecaster"],
        ["train", "policy"],
        ["train", "dher", "--task", "fetch_reach"],
        *(["bench", name] for name in ("replan", "env", "kinematics", "all")),
    ],
    ids=" ".join,
)
def test_help_answers_without_anything_heavy(words):
    script = (
        "import sys\nfrom torchdyn_plan.cli import main\n"
        f"try:\n    main({[*words, '--help']!r})\nexcept SystemExit as end:\n    assert end.code == 0\n"
        f"print('heavy:', [name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "heavy: []"
    assert "usage: torchdyn-plan" in done.stdout


def test_the_installed_command_is_this_one():
    from importlib.metadata import entry_points

    (entry,) = entry_points(group="console_scripts", name="torchdyn-plan")
    assert entry.load() is cli.main


@pytest.mark.parametrize("module", ["torchdyn_plan", "torchdyn_plan.cli"])
def test_the_package_runs_as_a_module(module):
    run = [sys.executable, "-m", module, "--help"]
    done = subprocess.run(run, capture_output=True, text=True, check=True)
    assert "usage: torchdyn-plan" in done.stdout
    assert done.stderr == ""


def test_each_task_shows_its_own_options_alone(capsys):
    trapper, fetch = (helped(["evaluate", "--task", name], capsys) for name in ("trapper", "fetch_reach"))
    for own, other, words in (
        (trapper, fetch, ("--friction", "Velocity of the ball at the start [m/s].", "wait_and_drop", "{ik,rl}")),
        (fetch, trapper, ("--goal-range", "--threshold", "{straight,circle,random}", "dher", "{proportional,rl}")),
    ):
        for word in words:
            assert word in own
            assert word not in other
    assert "{velocity,friction}" in helped(["sweep"], capsys)
    assert "{velocity}" in helped(["sweep", "--task=fetch_reach"], capsys)


def test_each_network_shows_its_own_options_alone(capsys):
    forecaster, policy = (helped(["train", name], capsys) for name in ("forecaster", "policy"))
    dher = helped(["train", "dher", "--task", "fetch_reach"], capsys)
    for word in ("--out", "--steps", "--batch", "--lr", "--seed", "--device", "--resume"):
        assert all(word in shown for shown in (forecaster, policy, dher))
    for word in ("--num-envs", "--workers", "--threads"):
        assert word not in forecaster
        assert word in policy
        assert word in dher
    assert "--data" in forecaster
    assert "--data" not in policy
    assert "--algorithm {ddpg,averaged}" in policy
    assert "--algorithm" not in forecaster
    assert "--period" in policy
    assert "--period" not in dher
    assert "--velocity" in dher
    assert "--velocity" not in policy
    overview = helped(["train"], capsys)
    assert "dher" not in overview
    for name in ("forecaster", "spread", "eta", "policy"):
        assert name in overview


def test_each_benchmark_shows_its_own_options_alone(capsys):
    replan, env, kinematics = (helped(["bench", name], capsys) for name in ("replan", "env", "kinematics"))
    for word in ("--planner", "--batches", "--seconds", "--threads", "--device", "wait_and_drop", "{ik,rl}"):
        assert word in replan
        assert word not in env
        assert word not in kinematics
    for word in ("--task", "--out"):
        assert all(word in shown for shown in (replan, env, kinematics))
    assert "--compiled" in replan
    assert "--compiled" in kinematics
    assert "--compiled" not in env
    assert "{proportional,rl}" in helped(["bench", "replan", "--task", "fetch_reach"], capsys)
    assert all(name in helped(["bench"], capsys) for name in ("replan", "env", "kinematics"))


HUGE = "1" * 30
BAD = [
    (["evaluate", "--planners", "pursit"], "unknown planner of trapper 'pursit' (did you mean 'pursuit'?)"),
    (["evaluate", "--planners", "pursuit", "pursuit"], "planners must be named once each"),
    (["evaluate", "--planners"], "planners must name at least one of"),
    (["evaluate", "--static", "kuka"], "unknown static planner of trapper 'kuka'"),
    (["evaluate", "--task", "fetch_raech"], "unknown task 'fetch_raech' (did you mean 'fetch_reach'?)"),
    (["evaluate", "--task"], "--task names none; choose from catch, chase, conveyor, fetch_reach, trapper"),
    (["evaluate", "--task", "no.such.module:TASK"], "no task at 'no.such.module:TASK': No module named 'no'"),
    (["evaluate", "--task", "fetch_reach", "--planners", "wait_and_drop"], "unknown planner of fetch_reach"),
    (["evaluate", "--task", "fetch_reach", "--velocity", "3"], "velocity must be in [0, 0.2], got 3.0"),
    (["evaluate", "--task", "fetch_reach", "--motion", "zigzag"], "unknown motion 'zigzag'"),
    (["evaluate", "--split", "final"], "split 'final' is played once a release, by benchmarks/final.py"),
    (["evaluate", "--split", "tets"], "unknown split 'tets' (did you mean 'test'?)"),
    (["evaluate", "--velocity", "-1"], "velocity must be in [0, 20], got -1.0"),
    (["evaluate", "--velocity", "nan"], "velocity must be a finite number, got nan"),
    (["evaluate", "--friction", "-0.5"], "friction must be in [0, 1000], got -0.5"),
    (["evaluate", "--sensor.noise", "-0.1"], "noise must be in [0, 10], got -0.1"),
    (["evaluate", "--sensor.rate", "0"], "rate must be in [1, 10000], got 0.0"),
    (["evaluate", "--track", "kalmann"], "unknown track 'kalmann' (did you mean 'kalman'?)"),
    (["evaluate", "--track.noise", "0.1"], "noise of a track, but there is none: choose least_squares or kalman"),
    (["evaluate", "--track", "kalman", "--track.window", "1"], "unknown setting of track kalman 'window'"),
    (["evaluate", "--track", "least_squares", "--track.noise", "-1"], "noise must be >= 1e-06, got -1.0"),
    (["sweep", "--over", "velocity", "--out", "{new}", "--track", "held"], "unknown track 'held'"),
    (["evaluate", "--latency-ms", "10"], "latency_ms must be whole control steps of 4 ms, got 10"),
    (["evaluate", "--task", "fetch_reach", "--latency-ms", "20"], "latency_ms must be whole control steps of 40 ms"),
    (["evaluate", "--latency-ms", "-4"], "latency_ms must be >= 0, got -4.0"),
    (["evaluate", "--episodes", "0"], "episodes must be >= 1, got 0"),
    (["evaluate", "--num-envs", "0"], "num_envs must be >= 1, got 0"),
    (["evaluate", "--seed", "-1"], "seed must be >= 0, got -1"),
    (["evaluate", "--out", "{file}"], "output folder '{file}' is not writable: File exists"),
    (["evaluate", "--out", "{file}/below"], "output folder '{file}/below' is not writable: Not a directory"),
    (["evaluate", "--out", ""], "--out is given nothing"),
    (["evaluate", "--out="], "--out is given nothing"),
    (["sweep", "--over", "velocity", "--out", ""], "--out is given nothing"),
    (["evaluate", "--latency-ms", "1e9"], "latency_ms must be no longer than an episode of trapper, 2000 ms"),
    (["evaluate", "--episodes", HUGE], "episodes must be a number of at most 18 digits, got one of 30"),
    (["evaluate", "--episodes", "1" * 12], "episodes must be <= 10000000"),
    (["evaluate", "--seed", HUGE], "seed must be a number of at most 18 digits"),
    (["evaluate", "--num-envs", HUGE], "num_envs must be a number of at most 18 digits"),
    (["evaluate", "--threads", HUGE], "num_threads must be a number of at most 18 digits"),
    (["evaluate", "--threads", "9999999"], "num_threads must be <= 1024"),
    (["evaluate", "--velocity", HUGE], "velocity must be in [0, 20]"),
    (["evaluate", "--friction", HUGE], "friction must be in [0, 1000]"),
    (["evaluate", "--latency-ms", HUGE], "latency_ms must be no longer than"),
    (["evaluate", "--weights", "x" * 300], "no weights 'xxx"),
    (["evaluate", "--out", "x" * 300], "output folder 'xxx"),
    (["sweep", "--over", "velocity", "--out", "{new}", "--repeats", HUGE], "repeats must be a number of at most"),
    (["sweep", "--over", "friction", "--out", "{new}", "--values", "1e30"], "friction must be in [0, 1000]"),
    (["collect", "paths", "--out", "{new}", "--episodes", HUGE], "episodes must be a number of at most"),
    (["collect", "paths", "--out", "{new}", "--seed", HUGE], "seed must be a number of at most"),
    (["collect", "paths", "--out", "{new}", "--threads", HUGE], "num_threads must be a number of at most"),
    (["train", "eta", "--steps", HUGE, "--out", "{new}"], "steps must be a number of at most"),
    (["train", "eta", "--seed", HUGE, "--out", "{new}"], "seed must be a number of at most"),
    (["train", "eta", "--device", "meta", "--out", "{new}"], "device 'meta' cannot be used"),
    (["train", "policy", "--device", "meta", "--out", "{new}"], "device 'meta' cannot be used"),
    (["train", "policy", "--threads", HUGE, "--out", "{new}"], "num_threads must be a number of at most"),
    (["train", "policy", "--num-envs", HUGE, "--out", "{new}"], "num_envs must be a number of at most"),
    (["train", "policy", "--workers", HUGE, "--out", "{new}"], "workers must be a number of at most"),
    (["train", "policy", "--period", HUGE, "--out", "{new}"], "period must be a number of at most"),
    (["bench", "replan", "--device", "meta"], "device 'meta' cannot be used"),
    (["bench", "replan", "--batches", HUGE], "batches must be a number of at most"),
    (["bench", "replan", "--seconds", "1e30"], "seconds must be <= 3600"),
    (["bench", "env", "--out", "{new}/x.png"], "output file '{new}/x.png' must end in .json"),
    (["sweep", "--over", "velocity", "--out", "{file}"], "output folder '{file}' is not writable"),
    (["sweep", "--over", "speed", "--out", "{new}"], "unknown setting of trapper to sweep over 'speed'"),
    (["sweep", "--over", "velocity", "--out", "{new}", "--values", "1", "nan"], "velocity must be a finite number"),
    (["sweep", "--over", "velocity", "--out", "{new}", "--values", "1", "1"], "values must differ, got 1.0 1.0"),
    (["sweep", "--over", "friction", "--out", "{new}", "--values", "-1"], "friction must be in [0, 1000]"),
    (["sweep", "--over", "friction", "--out", "{new}", "--repeats", "0"], "repeats must be >= 1"),
    (["collect", "paths", "--task", "trappr"], "unknown task 'trappr' (did you mean 'trapper'?)"),
    (["collect", "pahts", "--out", "{out}"], "unknown kind of data 'pahts' (did you mean 'paths'?)"),
    (["collect", "paths", "--out", "{file}"], "output folder '{file}' is not writable"),
    (["collect", "arrivals", "--static", "kuka", "--out", "{out}"], "unknown static planner of trapper 'kuka'"),
    (["collect", "arrivals", "--weights", "{new}", "--out", "{out}"], "no weights '{new}'"),
    (["collect", "arrivals", "--planner", "nowhere:make", "--out", "{new}"], "no planner at 'nowhere:make'"),
    (
        ["collect", "arrivals", "--planner", "math:pi", "--out", "{new}"],
        "a planner takes and returns a tensordict, but 'math:pi' is float",
    ),
    (["collect", "paths", "--planner", "math:cos", "--out", "{new}"], "--planner is of arrivals, not of paths"),
    (["train", "dher"], "unknown network of trapper 'dher'; choose from capture, eta, forecaster, nearest_eta, noisy_"),
    (["train", "eta", "--static", "kuka", "--out", "{new}"], "unknown static planner of trapper 'kuka'"),
    (["train", "eta"], "no arrivals-*.json in 'runs/data/trapper-ik'"),
    (["train", "eta", "--static", "rl"], "no arrivals-*.json in 'runs/data/trapper-rl'"),
    (["train", "forecaster", "--task", "fetch_reach"], "no paths-*.json in 'runs/data/fetch_reach-proportional'"),
    (["train", "eta", "--data", "{new}", "--out", "{out}"], "no arrivals-*.json in '{new}'"),
    (["train", "forecaster", "--data", "{new}", "--out", "{out}"], "no paths-*.json in '{new}'"),
    (["train", "spread", "--task", "fetch_reach", "--out", "{out}"], "fetch_reach"),
    (["train", "eta", "--out", "{file}"], "output folder '{file}' is not writable"),
    (["train", "eta", "--lr", "nan", "--out", "{out}"], "lr must be a finite number, got nan"),
    (["train", "eta", "--device", "gpu", "--data", "{new}", "--out", "{out}"], "device 'gpu' cannot be used"),
    (["train", "policy", "--num-envs", "0", "--out", "{out}"], "num_envs must be >= 1, got 0"),
    (
        ["train", "policy", "--algorithm", "sac", "--out", "{out}"],
        "unknown algorithm 'sac'; choose from averaged, ddpg",
    ),
    (["train", "policy", "--period", "0", "--out", "{out}"], "period must be >= 1, got 0"),
    (["train", "dher", "--task", "fetch_reach", "--velocity", "1", "--out", "{out}"], "velocity must be in [0, 0.2]"),
    (["train", "policy", "--out", "{file}"], "output folder '{file}' is not writable"),
    (["train", "policy", "--device", "gpu", "--out", "{out}"], "device 'gpu' cannot be used"),
    (
        ["train", "policy", "--num-envs", "3", "--workers", "2", "--out", "{out}"],
        "workers must divide num_envs 3",
    ),
    (["bench", "repaln"], "unknown benchmark 'repaln' (did you mean 'replan'?)"),
    (["bench", "replan", "--planner", "cornr"], "unknown planner of trapper 'cornr' (did you mean 'corner'?)"),
    (["bench", "replan", "--planner", "no.such.module:X"], "no planner at 'no.such.module:X': No module named 'no'"),
    (["bench", "replan", "--planner", "{folder}"], "folder '{folder}' holds no planner"),
    (["bench", "replan", "--planner", "corner", "--planner", "corner"], "planners must be named once each"),
    (["bench", "replan", "--device", "gpu"], "device 'gpu' cannot be used"),
    (["bench", "replan", "--batches", "1", "0"], "batches must be >= 1, got 0"),
    (["bench", "replan", "--seconds", "nan"], "seconds must be a finite number, got nan"),
    (["bench", "replan", "--threads", "-1"], "threads must be >= 0, got -1"),
    (["bench", "replan", "--static", "kuka"], "unknown static planner of trapper 'kuka'"),
    (["bench", "replan", "--weights", "{new}"], "no weights"),
    (["bench", "replan", "--out", "{folder}"], "output file '{folder}' is a folder"),
    (["bench", "env", "--out", "{file}/env.json"], "output folder '{file}' is not writable"),
    (["bench", "env", "--out", "{folder}"], "output file '{folder}' is a folder"),
]


@pytest.mark.parametrize(("words", "message"), BAD, ids=[" ".join(words)[:80] for words, _ in BAD])
def test_a_mistake_is_told_in_one_line(words, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    places = {"file": tmp_path / "file", "new": tmp_path / "new", "out": tmp_path / "out", "folder": tmp_path}
    places["file"].write_text("in the way")
    code, out, err = answer([word.format(**places) for word in words], capsys)
    assert code == 2
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith("torchdyn-plan: error: " + message.format(**places))
    assert places["file"].read_text() == "in the way"
    assert not places["new"].exists(), "an empty folder is left"
    assert not places["out"].exists(), "an empty folder is left"
    assert not (tmp_path / "runs").exists(), "an empty folder is left"


@pytest.mark.parametrize("words", [["evaluat"], ["evaluate", "--episode"], ["evaluate", "--velocity", "fast"], []])
def test_words_that_are_no_command_are_refused_without_a_traceback(words, capsys):
    code, _, err = answer(words, capsys)
    assert code == 2
    assert "Traceback" not in err


def test_weights_that_are_missing_are_named_before_anything_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pretrained, "SHIPPED", tmp_path)
    code, _, err = answer(["evaluate", "--planners", "corner", "--episodes", "1"], capsys)
    assert code == 2
    assert err.splitlines()[-1].startswith("torchdyn-plan: error: no weights 'trapper' for Forecaster")


@pytest.fixture
def quick(monkeypatch):
    """Short episodes, and a map that says that the arm is everywhere after 40 steps."""
    everywhere = ArrivalMap(torch.full((3, 3), 40), TrapperScene().half_side)
    monkeypatch.setattr(solvable, "arrival_map", lambda *_, **__: everywhere)

    def make_env(settings, **batch):
        return TrapperEnv(velocity=settings.velocity, friction=settings.friction, max_steps=130, **batch)

    monkeypatch.setitem(tasks.task._registered, "trapper", dataclasses.replace(TASK, make_env=make_env))


@pytest.mark.usefixtures("quick")
def test_evaluate_prints_a_table_and_writes_everything(tmp_path, capsys):
    words = ["evaluate", "--planners", "pursuit", "--velocity", 0.5, "--episodes", 16, "--num-envs", 5, "--threads", 1]
    code, out, _ = answer([*words, "--split", "dev", "--out", tmp_path / "new" / "run"], capsys)
    assert code == 0
    assert "pursuit" in out
    assert "steps to trap" in out
    folder = tmp_path / "new" / "run"
    assert sorted(path.name for path in folder.iterdir()) == ["episodes.json", "results.json", "results.png"]
    results = json.loads((folder / "results.json").read_text())
    assert set(results) == {"config", "versions", "machine", "rows"}
    config = {"task": "trapper", "planners": ["pursuit"], "episodes": 16, "seed": 0, "split": "dev"}
    config["settings"] = {"velocity": 0.5, "friction": 0.0}
    assert config.items() <= results["config"].items()
    assert results["config"]["scene"] == TrapperScene().digest()
    (row,) = results["rows"]
    assert set(row) == ROW
    low, high = row["success_ci"]
    assert 0 <= low <= row["success"] <= high <= 1
    assert 0 < row["solvable"] <= 1
    assert 0 <= row["success_solvable_ci"][0] <= row["success_solvable"] <= row["success_solvable_ci"][1] <= 1
    assert all(0 <= share <= 1 for share in row["failures"].values())
    assert sum(row["failures"].values()) + row["success"] == pytest.approx(1.0)
    episodes = json.loads((folder / "episodes.json").read_text())["pursuit"]
    assert sum(episodes["trapped"]) == 16 * row["success"] > 0
    assert (folder / "results.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("quick")
def test_a_task_of_another_module_is_found_from_the_working_folder(tmp_path, capsys):
    words = ["evaluate", "--task", "tests.evaluation.toy_task:TASK", "--drift", 0.02, "--episodes", 8, "--threads", 1]
    code, out, err = answer([*words, "--out", tmp_path], capsys)
    assert code == 0, err
    assert "steps to catch" in out
    assert "drift 0.02 m a step" in out
    assert json.loads((tmp_path / "results.json").read_text())["config"]["task"] == "drift"
    shown = helped(["evaluate", "--task", "tests.evaluation.toy_task:TASK"], capsys)
    assert "How far the point drifts [m a step]. (default: 0.01)" in shown
    code, _, err = answer(["train", "forecaster", "--task", "tests.evaluation.toy_task:TASK"], capsys)
    assert (code, err) == (2, "torchdyn-plan: error: drift has no network to train\n")


def test_bench_replan_prints_and_writes_the_planners_that_are_named(tmp_path, capsys):
    out = tmp_path / "figures.json"
    words = ["bench", "replan", "--planner", "tests.bench.own:PLANNER", "--planner", "pursuit", "--batches", 1, 3]
    code, shown, err = answer([*words, "--seconds", 0, "--threads", 1, "--out", out], capsys)
    assert code == 0, err
    content = json.loads(out.read_text())
    lines = shown.splitlines()
    assert len(lines) == len(content["rows"])
    for line, row in zip(lines, content["rows"], strict=True):
        assert line.startswith(f"what {row['what']}  implementation {row['implementation']}  compiled False")
    assert {"re-plan, tests.bench.own:PLANNER", "step, pursuit"} <= {row["what"] for row in content["rows"]}
    assert {row["batch"] for row in content["rows"]} == {1, 3}
    assert content["complete"]
    assert content["config"]["batches"] == [1, 3]


@pytest.mark.slow  # a process that starts from nothing and measures; `make torture` kills every other command
def test_a_bench_that_is_killed_has_written_what_it_measured(tmp_path):
    out = tmp_path / "figures.json"
    words = f"bench replan --planner corner --batches 1 --seconds 2 --out {out}".split()
    killed = subprocess.Popen(
        [sys.executable, "-c", "from torchdyn_plan.cli import main; main()", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    first = killed.stdout.readline()
    killed.kill()
    killed.communicate()
    content = json.loads(out.read_text())
    assert first.startswith(f"what {content['rows'][0]['what']} ")
    assert len(content["rows"]) in {1, 2}
    assert not content["complete"]


def outcome(settings, seed):
    """An outcome that depends on the setting alone."""
    random = torch.Generator().manual_seed(int(10 * settings.velocity) + seed)
    success, solvable, pocketed = (torch.rand(4, generator=random) < 0.5 for _ in range(3))
    return {
        "pursuit": EpisodeOutcomes(
            success=success,
            steps=torch.where(success, 90, -1),
            replans=torch.zeros(4, dtype=torch.int64),
            solvable=solvable,
            flags={"pocketed": pocketed},
            cause=torch.where(success, NO_CAUSE, 0),
            causes=TASK.causes,
            seconds=1.0,
        )
    }


def test_a_killed_sweep_continues_and_ends_as_one_that_was_not(tmp_path, monkeypatch, capsys):
    ran = []

    def run(self, settings, seed):
        if len(ran) == 3 and None not in ran:
            ran.append(None)
            raise KeyboardInterrupt
        ran.append((settings.velocity, seed))
        return outcome(settings, seed)

    monkeypatch.setattr(Study, "run", run)
    words = ["sweep", "--over", "velocity", "--planners", "pursuit", "--values", 0, 1.5, "--repeats", 2]
    words += ["--episodes", 4, "--seed", 5, "--out"]
    code, _, err = answer([*words, tmp_path / "killed"], capsys)
    assert code == 130
    assert err.splitlines()[-1] == "torchdyn-plan: interrupted"
    assert not (tmp_path / "killed" / "results.json").exists()
    code, out, _ = answer([*words, tmp_path / "killed"], capsys)
    assert code == 0
    assert "pursuit" in out
    assert ran == [(0.0, 5), (1.5, 5), (0.0, 6), None, (1.5, 6)]
    assert answer([*words, tmp_path / "whole"], capsys)[0] == 0
    one, other = (json.loads((tmp_path / name / "results.json").read_text()) for name in ("killed", "whole"))
    assert one["rows"] == other["rows"]
    assert [(row["settings"]["velocity"], row["episodes"]) for row in one["rows"]] == [(0.0, 8), (1.5, 8)]
    code, _, err = answer([*words, tmp_path / "killed", "--friction", "1"], capsys)
    assert code == 2
    assert "holds a sweep with another configuration: friction is 0.0 there, 1.0 here" in err


EVALUATES = "evaluate --planners pursuit --episodes 2 --num-envs 2 --split dev --threads 1 --out results"
TO_NOBODY = """
import os, sys
read, write = os.pipe()
os.close(read)
sys.stdout = open(write, "w")
"""
# Whatever another encoding lacks, this one does.
TO_ASCII = """
import sys
sys.stdout.reconfigure(encoding="ascii", errors="strict")
"""
MAIN = """
from torchdyn_plan.cli import main
main()
"""


def test_results_are_saved_though_nobody_reads_the_table(tmp_path):
    done = run(TO_NOBODY + MAIN, *EVALUATES.split(), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "BrokenPipe" not in done.stderr
    assert {"results.json", "episodes.json", "results.png"} <= {file.name for file in (tmp_path / "results").iterdir()}


def test_a_terminal_without_our_signs_still_gets_the_table(tmp_path):
    done = run(TO_ASCII + MAIN, *EVALUATES.split(), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "pursuit" in done.stdout
    assert done.stdout.isascii()
    assert (tmp_path / "results" / "results.json").is_file()


@pytest.mark.skipif(find_spec("ray") is not None, reason="Ray is here")
def test_workers_without_ray_name_the_extra(tmp_path, capsys):
    code, _, err = answer(["train", "policy", "--workers", "1", "--num-envs", "2", "--out", tmp_path / "new"], capsys)
    assert code == 2
    assert err.splitlines()[-1] == "torchdyn-plan: error: workers need Ray: pip install 'torchdyn-plan[ray]'"
    assert not (tmp_path / "new").exists()


def test_sigterm_ends_like_ctrl_c(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Study, "run", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    out = tmp_path / "new"
    words = ["evaluate", "--planners", "pursuit", "--episodes", "1", "--out", out]
    before = signal.getsignal(signal.SIGTERM)
    assert answer(words, capsys) == (143, "", "torchdyn-plan: terminated\n")
    assert signal.getsignal(signal.SIGTERM) == before
    assert not out.exists()


@pytest.mark.parametrize(
    ("raised", "told"),
    [
        (OSError(28, "No space left on device"), "No space left on device"),
        (MemoryError(), "not enough memory"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: not enough memory: you tried"), "not enough memory"),
    ],
)
def test_a_machine_that_has_not_enough_is_no_traceback(raised, told, monkeypatch, capsys):
    def run(*_):
        raise raised

    monkeypatch.setattr(Study, "run", run)
    code, _, err = answer(["evaluate", "--planners", "pursuit", "--episodes", "1"], capsys)
    assert code == 2
    assert told in err
    assert len(err.splitlines()) == 1


def test_a_closed_pipe_does_not_end_a_benchmark(monkeypatch):
    """What is said goes nowhere from then on; what is measured goes on."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        say("one")
        say("two")
        monkeypatch.undo()


@pytest.mark.usefixtures("quick")
def test_what_cannot_be_saved_is_told_at_least(tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    words = ["evaluate", "--planners", "pursuit", "--episodes", 2, "--threads", 1, "--out", tmp_path / "new"]
    code, out, err = answer(words, capsys)
    assert code == 2
    assert "pursuit" in out
    assert err.splitlines()[-1].startswith("torchdyn-plan: error: cannot write ")
    assert err.splitlines()[-1].endswith("episodes.json': No space left on device")
    assert not (tmp_path / "new").exists()


def test_a_scene_is_named_beside_its_task(capsys):
    with pytest.raises(SystemExit):
        cli.main(["evaluate", "--help"])
    assert "--scene" in capsys.readouterr().out
    for words, message in (
        (["evaluate", "--scene", "papr"], "unknown scene of trapper 'papr' (did you mean 'paper'?)"),
        (["evaluate", "--task", "fetch_reach", "--scene", "paper"], "fetch_reach has one scene alone, got 'paper'"),
        (["evaluate", "--scene"], "--scene names none"),
    ):
        with pytest.raises(SystemExit) as stopped:
            cli.main(words)
        assert stopped.value.code == 2
        assert message in capsys.readouterr().err
