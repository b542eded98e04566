import json
import re
import subprocess
from pathlib import Path

import pytest

from torchdyn_plan import versions
from torchdyn_plan.bench import series
from torchdyn_plan.cli.arguments import BENCHMARKS
from torchdyn_plan.errors import InputError


def test_every_benchmark_that_there_is_is_in_the_series():
    assert set(series.BENCHMARKS) == set(BENCHMARKS) - {"all"}
    for name, function in series.BENCHMARKS.items():
        assert function.__module__ == BENCHMARKS[name]


def test_rows_of_all_benchmarks_are_in_one_file(monkeypatch, tmp_path):
    given = {}

    def fake(name):
        def bench(*, show, **arguments):
            given[name] = arguments
            show({"what": name, "median_us": 1.0})
            return []

        return bench

    monkeypatch.setattr(series, "BENCHMARKS", {name: fake(name) for name in series.BENCHMARKS})
    out, shown = tmp_path / "bench.json", []
    rows = series.bench("trapper", seconds=0.1, out=out, progress=False, show=shown.append)
    content = json.loads(out.read_text())
    assert content.keys() == {"config", "machine", "versions", "commit", "complete", "rows"}
    assert content["complete"]
    assert content["rows"] == rows == shown
    assert [row["benchmark"] for row in rows] == ["kinematics", "replan", "env"]
    assert given["replan"]["seconds"] == given["kinematics"]["seconds"] == 0.1
    assert "seconds" not in given["env"]
    assert {one["task"].name for one in given.values()} == {"trapper"}


def test_a_benchmark_may_run_alone_and_really_measures():
    pytest.importorskip("mujoco")
    rows = series.bench(only={"env": {"planners": {}, "sizes": (2,), "steps": 2, "threads": 1}}, progress=False)
    assert {row["benchmark"] for row in rows} == {"env"}
    assert all(row["median_us"] > 0.0 for row in rows)
    with pytest.raises(InputError, match=r"seconds must be .* got -1"):
        series.bench(seconds=-1.0)


def test_the_commit_is_that_of_the_checkout(monkeypatch, tmp_path):
    run = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    package = tmp_path / "torchdyn_plan"
    package.mkdir()
    (package / "versions.py").write_text("")
    monkeypatch.setattr(versions, "__file__", str(package / "versions.py"))
    assert versions.source_commit() is None
    subprocess.run([*run, "init", "-q"], check=True)
    subprocess.run([*run, "add", "."], check=True)
    subprocess.run([*run, "commit", "-qm", "first"], check=True)
    commit = subprocess.run([*run, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout.strip()
    assert versions.source_commit() == commit[:12]
    (package / "versions.py").write_text("changed")
    assert versions.source_commit() == f"{commit[:12]}-dirty"
    assert re.fullmatch(r"[0-9a-f]{12}(-dirty)?", versions.source_commit() or "")
    monkeypatch.setenv("PATH", "")
    assert versions.source_commit() is None


def test_the_history_is_read_out_of_commits(tmp_path):
    import sys

    root = Path(__file__).parents[2]
    run = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run([*run, "init", "-q"], check=True)
    results = tmp_path / "benchmarks" / "results"
    results.mkdir(parents=True)
    row = {"what": "random", "implementation": "TrapperEnv", "batch": 2048, "compiled": False, "device": "cpu"}
    for number, (name, rows) in enumerate(
        (
            ("env", [row | {"share_of_raw": 0.5}]),
            ("bench", [row | {"benchmark": "env", "share_of_raw": 0.75}, row | {"benchmark": "other"}]),
        )
    ):
        (results / f"{name}.json").write_text(json.dumps({"rows": rows}))
        subprocess.run([*run, "add", "."], check=True)
        at = {
            "GIT_COMMITTER_DATE": f"2026-01-0{number + 1}T12:00:00+0000",
            "PATH": "/usr/bin:/bin",
            "HOME": str(tmp_path),
        }
        subprocess.run([*run, "commit", "-qm", name], check=True, env=at)
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- history -->\nold\n<!-- /history -->\nafter\n")
    words = [sys.executable, root / "tools" / "bench_history.py", "--repository", tmp_path, "--write", page]
    subprocess.run(words, check=True)
    text = page.read_text()
    assert text.startswith("before\n<!-- history -->")
    assert text.endswith("<!-- /history -->\nafter\n")
    assert "old" not in text
    lines = re.findall(r"^\| [0-9a-f]{7,} \| (\S+) \| (\S+) \| – \| – \|$", text, re.MULTILINE)
    assert lines == [("2026-01-01", "0.5"), ("2026-01-02", "0.75")]
