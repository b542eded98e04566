"""Every script in ``benchmarks`` runs, on next to nothing, and writes what it measured beside versions and machine."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
SMALL = {
    "ablation": "--velocities 3 --episodes 4 --num-envs 4 --split dev",
    "calibration": "--episodes 8 --pursuit-episodes 8 --split dev",
    "ceiling": "--velocities 5 --episodes 3 --spacing 60 --meetings 1 --leads 7 --rows 64 --split dev",
    "forecast_gain": "--episodes 4 --seeds 0",
    "joint_speeds": "--episodes 4 --num-envs 4",
    "latency": "--velocities 3 --episodes 4 --latencies 0 20 --unaware 20",
    "reach_ceiling": "--velocities 0.03 --episodes 8 --other-velocities 0.03 --other-episodes 8 --bounds-alone",
    "reach_env": "--copies 2 --steps 4 --threads 1",
    "recovery": "--planners meet --statics ik --velocities 3 --episodes 4 --split dev",
    "schedules": "--planners meet --velocities 3 --schedules paper --episodes 4",
    "static_task": "--episodes 8 --split dev",
}
ELSEWHERE = {"diagnose", "killed_training", "measure_arrivals", "policy_curves", "policy_peers"}
"""Minutes at the least, a picture of trainings, or what the package's own arrival map is made by."""


@pytest.mark.parametrize("name", SMALL)
def test_benchmark_runs(name, tmp_path):
    if name.startswith("reach") and importlib.util.find_spec("gymnasium_robotics") is None:
        pytest.skip("gymnasium-robotics has the arm")
    out = tmp_path / "figures.json"
    run = subprocess.run(
        [sys.executable, BENCHMARKS / f"{name}.py", *SMALL[name].split(), "--out", out],
        cwd=BENCHMARKS.parent,
        env={"PYTHONPATH": str(BENCHMARKS.parent), "OMP_NUM_THREADS": "1", "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr
    figures = json.loads(out.read_text())
    assert figures.keys() >= {"machine", "versions"}
    assert len(figures["rows"]) > 0


def test_no_benchmark_is_forgotten():
    assert {file.stem for file in BENCHMARKS.glob("*.py")} == SMALL.keys() | ELSEWHERE
