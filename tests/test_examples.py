import subprocess
import sys
from pathlib import Path

import pytest

from tests.menagerie import write as write_menagerie

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("01_trap_a_ball.py", "ours        traps"),
        ("02_own_static_planner.py", "target 0.0"),
        ("04_place_the_base.py", "40 of 40 goals reached"),
        ("train_ddpg_her.py --rounds 2 --num-envs 2 --updates 2", "round    2: mean reward"),
        ("06_any_planner.py", "wait_and_drop, mj_jac"),
        ("05_real_time_loop.py", "plans came into use"),
        ("bench_own_planner.py", "re-plan, mine, for inference"),
        ("07_fine_tune_forecaster.py", "after: miss 0.0"),
        ("fine_tune_in_rollout.py --balls 4 --rounds 2 --steps 150", "round 2: "),
        ("collect_in_parallel.py --balls 2 --steps 120", "of 4 balls, "),
        ("stock_torchrl.py --frames 400 --warmup 200 --batch 32", "400 frames: return"),
        ("sb3_her.py --steps 250", "after 250 steps"),
    ],
)
def test_example_runs(name, says, tmp_path):
    file, *words = name.split()
    run = subprocess.run(
        [sys.executable, EXAMPLES / file, *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr
    assert says in run.stdout


def test_examples_are_short():
    for file in EXAMPLES.glob("*.py"):
        # A whole task is longer; tests/test_own_task.py runs it.
        longest = 120 if file.name == "own_task.py" else 80
        assert len(file.read_text().splitlines()) <= longest, file.name


def test_torchrls_own_arm_is_driven(tmp_path):
    pytest.importorskip("torchrl.envs", reason="TorchRL has the arm")
    folder = write_menagerie(tmp_path / "menagerie")
    run = subprocess.run(
        [sys.executable, EXAMPLES / "torchrl_arm.py", "--menagerie", folder],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr
    off = {line.split()[0]: float(line.split()[4]) for line in run.stdout.splitlines() if "the pinch is" in line}
    assert set(off) == {"above", "down", "up"}
    assert max(off.values()) < 5.0, run.stdout
    assert "1000 of 1000 poses solved at once" in run.stdout
