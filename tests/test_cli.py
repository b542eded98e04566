import json
import os
import subprocess
import sys

import pytest
import torch

from torchdyn_plan import cli
from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.evaluation import run
from torchdyn_plan.evaluation.results import EpisodeOutcomes
from torchdyn_plan.evaluation.solvability import ArrivalMap
from torchdyn_plan.nets import pretrained

ROW = {
    "planner", "static", "task", "velocity", "friction", "episodes", "success", "success_ci", "solvable",
    "success_solvable", "success_solvable_ci", "steps_to_trap", "replans", "failures", "episodes_per_second",
}  # fmt: skip
HEAVY = ("torch", "tensordict", "torchrl", "mujoco", "matplotlib", "numpy", "pytorch_kinematics")


def answer(words, capsys):
    """Exit code of ``torchdyn-plan words``, what it printed and what it complained."""
    code = 0
    try:
        cli.main([str(word) for word in words])
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    return code, out, err


@pytest.mark.parametrize("words", [["--help"], ["evaluate", "--help"], ["train", "--help"]])
def test_help_answers_without_anything_heavy(words):
    script = (
        "import sys\nfrom torchdyn_plan.cli import main\n"
        f"try:\n    main({words!r})\nexcept SystemExit as end:\n    assert end.code == 0\n"
        f"print('heavy:', [name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "heavy: []"
    assert "usage: torchdyn-plan" in done.stdout


def test_the_installed_command_is_this_one():
    done = subprocess.run(
        [sys.executable, "-m", "torchdyn_plan.cli"], capture_output=True, text=True, check=True
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("", "")
    from importlib.metadata import entry_points

    (entry,) = entry_points(group="console_scripts", name="torchdyn-plan")
    assert entry.load() is cli.main


BAD = [
    (["evaluate", "--planners", "pursit"], "unknown planner 'pursit' (did you mean 'pursuit'?)"),
    (["evaluate", "--planners", "pursuit", "pursuit"], "planners must be named once each"),
    (["evaluate", "--planners"], "planners must name at least one of"),
    (["evaluate", "--static", "kuka"], "unknown static planner 'kuka'"),
    (["evaluate", "--task", "raech"], "unknown task 'raech' (did you mean 'reach'?)"),
    (["evaluate", "--task", "reach", "--planners", "meet"], "unknown planner 'meet'"),
    (["evaluate", "--task", "reach", "--velocity", "3"], "velocity must be in [0, 0.2], got 3.0"),
    (["evaluate", "--task", "reach", "--velocity", "0.01", "--motion", "zigzag"], "unknown motion 'zigzag'"),
    (["collect", "paths", "--task", "raech"], "unknown task 'raech'"),
    (["train", "dher"], "dher is trained in reach alone"),
    (["evaluate", "--split", "tets"], "unknown split 'tets' (did you mean 'test'?)"),
    (["evaluate", "--velocity", "-1"], "velocity must be in [0, 20], got -1.0"),
    (["evaluate", "--velocity", "nan"], "velocity must be a finite number, got nan"),
    (["evaluate", "--friction", "-0.5"], "friction must be >= 0, got -0.5"),
    (["evaluate", "--latency-ms", "10"], "latency_ms must be whole control steps of 4 ms, got 10"),
    (["evaluate", "--latency-ms", "-4"], "latency_ms must be >= 0, got -4.0"),
    (["evaluate", "--episodes", "0"], "episodes must be >= 1, got 0"),
    (["evaluate", "--num-envs", "0"], "num_envs must be >= 1, got 0"),
    (["evaluate", "--seed", "-1"], "seed must be >= 0, got -1"),
    (["evaluate", "--out", "{file}"], "output folder '{file}' is not writable: File exists"),
    (["evaluate", "--out", "{file}/below"], "output folder '{file}/below' is not writable: Not a directory"),
    (["sweep", "--over", "velocity", "--out", "{file}"], "output folder '{file}' is not writable"),
    (["sweep", "--over", "velocity", "--out", "{new}", "--values", "1", "nan"], "velocity must be a finite number"),
    (["sweep", "--over", "velocity", "--out", "{new}", "--values", "1", "1"], "values must differ, got 1.0 1.0"),
    (["sweep", "--over", "friction", "--out", "{new}", "--values", "-1"], "friction must be >= 0"),
    (["sweep", "--over", "friction", "--out", "{new}", "--repeats", "0"], "repeats must be >= 1"),
    (["collect", "paths", "--out", "{file}"], "output folder '{file}' is not writable"),
    (["collect", "arrivals", "--static", "kuka"], "unknown static planner 'kuka'"),
    (["train", "eta", "--data", "{new}", "--out", "{out}"], "no arrivals-*.json in '{new}'"),
    (["train", "forecaster", "--data", "{new}", "--out", "{out}"], "no paths-*.json in '{new}'"),
    (["train", "eta", "--out", "{file}"], "output folder '{file}' is not writable"),
    (["train", "eta", "--lr", "nan"], "lr must be a finite number, got nan"),
    (["train", "eta", "--device", "gpu", "--data", "{new}", "--out", "{out}"], "device 'gpu' cannot be used"),
    (["collect", "arrivals", "--weights", "{new}"], "weights are of a policy"),
    (["collect", "arrivals", "--static", "rl", "--weights", "{new}", "--out", "{out}"], "no policy at '{new}'"),
    (["train", "policy", "--num-envs", "0"], "num_envs must be >= 1, got 0"),
    (["train", "policy", "--period", "0"], "period must be >= 1, got 0"),
    (["train", "policy", "--out", "{file}"], "output folder '{file}' is not writable"),
    (["train", "policy", "--device", "gpu", "--out", "{out}"], "device 'gpu' cannot be used"),
    (
        ["train", "policy", "--num-envs", "3", "--workers", "2", "--out", "{out}"],
        "workers must divide num_envs 3",
    ),
    (["bench", "repaln"], "unknown benchmark 'repaln' (did you mean 'replan'?)"),
    (["bench", "env", "--out", "{file}/env.json"], "output folder '{file}' is not writable"),
    (["bench", "env", "--out", "{folder}"], "output file '{folder}' is a folder"),
]


@pytest.mark.parametrize(("words", "message"), BAD, ids=[" ".join(words) for words, _ in BAD])
def test_a_mistake_is_told_in_one_line(words, message, tmp_path, capsys):
    places = {"file": tmp_path / "file", "new": tmp_path / "new", "out": tmp_path / "out", "folder": tmp_path}
    places["file"].write_text("in the way")
    code, out, err = answer([word.format(**places) for word in words], capsys)
    assert code == 2
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith("torchdyn-plan: error: " + message.format(**places))
    assert places["file"].read_text() == "in the way"


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
    monkeypatch.setattr(run, "arrival_map", lambda *_, **__: everywhere)
    monkeypatch.setattr(run, "TrapperEnv", lambda *args, **settings: TrapperEnv(*args, max_steps=130, **settings))


@pytest.mark.usefixtures("quick")
def test_evaluate_prints_a_table_and_writes_everything(tmp_path, capsys):
    words = ["evaluate", "--planners", "pursuit", "--velocity", 0.5, "--episodes", 16, "--num-envs", 5, "--threads", 1]
    code, out, _ = answer([*words, "--split", "dev", "--out", tmp_path / "new" / "run"], capsys)
    assert code == 0
    assert "pursuit" in out
    folder = tmp_path / "new" / "run"
    assert sorted(path.name for path in folder.iterdir()) == ["episodes.json", "results.json", "results.png"]
    results = json.loads((folder / "results.json").read_text())
    assert set(results) == {"config", "versions", "machine", "rows"}
    config = {"planners": ["pursuit"], "velocity": 0.5, "friction": 0.0, "episodes": 16, "seed": 0, "split": "dev"}
    assert config.items() <= results["config"].items()
    assert results["config"]["scene"] == TrapperScene().digest()
    (row,) = results["rows"]
    assert set(row) >= ROW
    low, high = row["success_ci"]
    assert 0 <= low <= row["success"] <= high <= 1
    assert 0 < row["solvable"] <= 1
    assert 0 <= row["success_solvable_ci"][0] <= row["success_solvable"] <= row["success_solvable_ci"][1] <= 1
    assert all(0 <= share <= 1 for share in row["failures"].values())
    assert sum(row["failures"].values()) + row["success"] == pytest.approx(1.0)
    episodes = json.loads((folder / "episodes.json").read_text())["pursuit"]
    assert sum(episodes["trapped"]) == 16 * row["success"] > 0
    assert (folder / "results.png").read_bytes().startswith(b"\x89PNG")


def outcome(arguments):
    """An outcome that depends on the setting alone."""
    random = torch.Generator().manual_seed(int(10 * arguments.velocity) + arguments.seed)
    flags = {name: torch.rand(4, generator=random) < 0.5 for name in ("trapped", "touched", "pocketed", "solvable")}
    steps = torch.where(flags["trapped"], 90, -1)
    return {"pursuit": EpisodeOutcomes(**flags, steps=steps, replans=torch.zeros(4, dtype=torch.int64), seconds=1.0)}


def test_a_killed_sweep_continues_and_ends_as_one_that_was_not(tmp_path, monkeypatch, capsys):
    ran = []

    def run_points(arguments):
        if len(ran) == 3 and None not in ran:
            ran.append(None)
            raise KeyboardInterrupt
        ran.append((arguments.velocity, arguments.seed))
        return outcome(arguments)

    monkeypatch.setattr(run, "run_points", run_points)
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
    assert [(row["velocity"], row["episodes"]) for row in one["rows"]] == [(0.0, 8), (1.5, 8)]
    code, _, err = answer([*words, tmp_path / "killed", "--friction", "1"], capsys)
    assert code == 2
    assert "holds a sweep with another configuration: friction is 0.0 there, 1.0 here" in err


def test_results_are_saved_though_nobody_reads_the_table(tmp_path):
    words = f"evaluate --planners pursuit --episodes 2 --num-envs 2 --split dev --threads 1 --out {tmp_path}".split()
    run = subprocess.Popen(
        [sys.executable, "-c", "from torchdyn_plan.cli import main; main()", *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    run.stdout.close()
    errors = run.stderr.read()
    assert run.wait(120) == 0, errors
    assert "Traceback" not in errors
    assert "BrokenPipe" not in errors
    assert {"results.json", "episodes.json", "results.png"} <= {file.name for file in tmp_path.iterdir()}


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_terminal_without_our_signs_still_gets_the_table(tmp_path, encoding):
    words = f"evaluate --planners pursuit --episodes 2 --num-envs 2 --split dev --threads 1 --out {tmp_path}".split()
    run = subprocess.run(
        [sys.executable, "-c", "from torchdyn_plan.cli import main; main()", *words],
        env={**os.environ, "PYTHONIOENCODING": encoding}, capture_output=True, check=False, timeout=120,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert b"pursuit" in run.stdout
    assert (tmp_path / "results.json").is_file()
