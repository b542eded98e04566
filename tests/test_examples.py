from pathlib import Path

import pytest
import torch

from tests.menagerie import write as write_menagerie
from tests.scripts import run
from torchdyn_plan import DynamicPlanner
from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.planners import Delayed, KalmanTrack, TrackedPlanner

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
        ("08_meet_a_walker.py meeting.webp", "written: meeting.webp"),
        ("09_take_parts_off_a_belt.py", "part 3 of 3 is off the belt"),
        ("10_meet_a_thrown_ball.py", "ball 3: in the cup"),
        ("fine_tune_in_rollout.py --balls 4 --rounds 2 --steps 150", "round 2: "),
        ("collect_in_parallel.py --balls 2 --steps 120", "of 4 balls, "),
        ("stock_torchrl.py --frames 400 --warmup 200 --batch 32", "400 frames: return"),
        ("sb3_her.py --steps 250", "after 250 steps"),
    ],
)
def test_example_runs(name, says, tmp_path):
    file, *words = name.split()
    ran = run(EXAMPLES / file, *words, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert says in ran.stdout


def test_the_real_time_loop_traps_what_the_same_measurements_trap_without_threads(tmp_path):
    ran = run(EXAMPLES / "05_real_time_loop.py", "--simulated", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    trapped, steps = real_time_loop_without_threads(balls=4)
    assert f"{trapped} of 4 balls trapped" in ran.stdout
    assert f"of {steps} steps took" in ran.stdout
    assert trapped >= 2


def real_time_loop_without_threads(balls):
    """Balls trapped and control steps of example 05, simulated, with every measurement made in the loop itself."""
    env = TrapperEnv(velocity=2.0, seed=0, split="dev", num_threads=1)
    inner = DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop").with_parts(delivery=Delayed(2))
    planner = TrackedPlanner(inner, KalmanTrack(noise=0.005), control_step=0.004)
    draw, state, ended, trapped, steps = torch.Generator().manual_seed(0), env.reset(), 0, 0, 0
    pictures = 0
    with torch.no_grad():
        while ended < balls:
            step = int(state["step_count"])
            pictures = pictures if step else 0
            state["measured_time"] = torch.full((1, 1), torch.nan)
            state["measured_pos"] = torch.full((1, 1, 3), torch.nan)
            # Thirty pictures a second are one in each 8 1/3 steps.
            if 3 * step >= 25 * pictures:
                pictures += 1
                state["measured_time"][0] = 0.004 * step
                state["measured_pos"][0] = state["target_pos"] + 0.005 * torch.randn(3, generator=draw)
            stepped, state = env.step_and_maybe_reset(planner(state))
            ended, trapped = ended + int(stepped["next", "done"]), trapped + int(stepped["next", "trapped"])
            steps += 1
    return trapped, steps


def test_examples_are_short():
    for file in EXAMPLES.glob("*.py"):
        # A whole task is longer; tests/test_own_task.py runs it.
        longest = 120 if file.name == "own_task.py" else 80
        assert len(file.read_text().splitlines()) <= longest, file.name


def test_torchrls_own_arm_is_driven(tmp_path):
    pytest.importorskip("torchrl.envs", reason="TorchRL has the arm")
    folder = write_menagerie(tmp_path / "menagerie")
    ran = run(EXAMPLES / "torchrl_arm.py", "--menagerie", folder, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    off = {line.split()[0]: float(line.split()[4]) for line in ran.stdout.splitlines() if "the pinch is" in line}
    assert set(off) == {"above", "down", "up"}
    assert max(off.values()) < 5.0, ran.stdout
    assert "1000 of 1000 poses solved at once" in ran.stdout
