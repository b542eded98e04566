"""`benchmarks/same_episodes.py` tells whether two runs are the same, and is not easily fooled."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "same_episodes.py"
TRAPPED = {"trapped": [True, False], "steps": [90, -1], "replans": [3, 4], "solvable": [True, True]}
REACHED = {"reached": [True, False], "steps": [90, -1], "replans": [3, 4], "solvable": [True, True]}
FORMER = ("reach", {"meet": TRAPPED | {"pocketed": [False, False], "cause": [None, "late"]}})
PRESENT = ("fetch_reach", {"wait_and_drop": REACHED})


def write(folder, task, episodes, seconds):
    folder.mkdir(parents=True)
    content = {planner: outcomes | {"seconds": seconds} for planner, outcomes in episodes.items()}
    (folder / "episodes.json").write_text(json.dumps(content))
    (folder / "results.json").write_text(json.dumps({"config": {"task": task}}))


def compare(tmp_path, before, after):
    write(tmp_path / "before" / "one", *before, seconds=1.0)
    write(tmp_path / "after" / "one", *after, seconds=2.0)
    words = [sys.executable, SCRIPT, tmp_path / "before", tmp_path / "after"]
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    return run.returncode, run.stdout


def test_former_names_are_read_by_the_present_ones(tmp_path):
    code, out = compare(tmp_path, FORMER, PRESENT)
    assert code == 0
    assert out.split() == ["one", "wait_and_drop,", "2", "episodes", "identical"]


@pytest.mark.parametrize(
    ("after", "told"),
    [
        ({"wait_and_drop": REACHED | {"steps": [91, -1]}}, "steps of episode 0 is 90 before, 91 after (1 of 2 differ)"),
        ({"wait_and_drop": REACHED | {"extra": [1, 2]}}, "entries extra are in one of them only"),
        ({"wait_and_drop": {name: values[:1] for name, values in REACHED.items()}}, "2 episodes before, 1 after"),
        ({"corner": REACHED}, "only before"),
        ({"wait_and_drop": REACHED, "corner": REACHED}, "only after"),
    ],
)
def test_any_difference_is_told(tmp_path, after, told):
    code, out = compare(tmp_path, FORMER, ("fetch_reach", after))
    assert code == 1
    assert told in out
