"""Another library's inverse kinematics becomes a planner that traps rolling balls, and is measured beside ours.

It knows only MuJoCo's Jacobian. Its arrival times are collected and learned. The defaults are quick; in earnest:
    python examples/06_any_planner.py --sequences 512 --num-envs 256 --steps 6000 --episodes 1000 --out FILE.json
"""

import tempfile
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro

from torchdyn_plan.cli_arguments import CollectArguments, EvaluateArguments
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.evaluation.planners import PLANNERS
from torchdyn_plan.evaluation.report import format_table
from torchdyn_plan.evaluation.results import summarize
from torchdyn_plan.evaluation.run import record_truth, run_episodes
from torchdyn_plan.files import write_json
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import CallablePlanner, DynamicPlanner, MeetingPlanner
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.fit import fit_eta

MODEL = TrapperScene().compile()
DATA, TOOL, FIRST = mujoco.MjData(MODEL), MODEL.site("tool").id, MODEL.joint("shoulder_pan")
ARM, DOFS = (slice(int(first[0]), int(first[0]) + 6) for first in (FIRST.qposadr, FIRST.dofadr))
BASE, STEP = np.array(TrapperScene().base_pos[:2]), np.pi * 0.004  # the arm's axis [m]; a joint's way in a step [rad]


def drive(joint_pos: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Static planner: damped least squares on MuJoCo's Jacobian, box upright and square, from above to the table."""
    return torch.tensor(np.array([_drive(*row) for row in zip(joint_pos.numpy(), goal.numpy(), strict=True)])).float()


def _drive(joint_pos: np.ndarray, goal: np.ndarray) -> np.ndarray:
    DATA.qpos[ARM], jacobian = joint_pos, np.zeros((6, MODEL.nv))
    mujoco.mj_kinematics(MODEL, DATA)
    mujoco.mj_comPos(MODEL, DATA)
    mujoco.mj_jacSite(MODEL, DATA, jacobian[:3], jacobian[3:], TOOL)
    place, axes = DATA.site_xpos[TOOL], DATA.site_xmat[TOOL].reshape(3, 3)
    way = np.clip(goal[:2], -0.72, 0.72) - BASE
    level = BASE + way * min(1.0, 0.9 / np.linalg.norm(way)) - place[:2]
    far, low = np.linalg.norm(level) > 0.05, place[2] < 0.08
    height = goal[2] if goal[2] > 0.052 else 0.099 if far else 0.006
    yaw = np.arctan2(axes[1, 0], axes[0, 0])
    square = np.round(yaw / (np.pi / 2)) * np.pi / 2 - yaw
    error = [*(level * (not (far and low))), height - place[2], -axes[1, 2], axes[0, 2], square]
    jacobian = jacobian[:, DOFS]
    change = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 4e-4 * np.eye(6), error)
    return change / STEP * min(0.25, STEP / max(np.abs(change).max(), 1e-9))


def main(*, sequences: int = 16, num_envs: int = 16, steps: int = 40, episodes: int = 4, split: str = "test",
         out: Path | None = None) -> None:  # fmt: skip
    """Collect, fit, evaluate at 3 m/s."""
    settings = {"sequences": sequences, "num_envs": num_envs, "steps": steps, "episodes": episodes, "split": split}
    torch.set_num_threads(1)
    static = CallablePlanner(drive, in_keys=("joint_pos", "goal"))
    with tempfile.TemporaryDirectory() as folder:
        wanted = CollectArguments(what="arrivals", out=Path(folder), episodes=sequences, num_envs=num_envs, threads=1)
        collect(wanted, static, name="mj_jac")
        eta = ETANetwork.from_pretrained(fit_eta(Path(folder), Path(folder), steps=steps))
    parts = static, Forecaster.from_pretrained("trapper"), eta
    setting = EvaluateArguments(episodes=episodes, num_envs=min(episodes, 500), split=split, threads=0)
    truth, rows = record_truth(setting), []
    for name, kind in (("corner", DynamicPlanner), ("meet", MeetingPlanner)):
        for whose, tried in (("mj_jac", kind(*parts)), ("ik", PLANNERS[name]("ik"))):
            outcome = run_episodes(tried, setting, *truth, name)
            rows.append(summarize(outcome, planner=name, static=whose, velocity=3.0, friction=0.0))
    print(format_table(rows))
    if out is not None:
        write_json(out, {"settings": settings, "rows": [vars(row) for row in rows]})


if __name__ == "__main__":
    tyro.cli(main)
