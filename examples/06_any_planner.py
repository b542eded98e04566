"""Another library's inverse kinematics becomes a planner that traps rolling balls, and is measured beside ours.

It knows only MuJoCo's Jacobian. Its arrival times are collected and learned. The defaults are quick; in earnest:
    python examples/06_any_planner.py --sequences 512 --num-envs 256 --steps 6000 --episodes 1000 --out FOLDER
"""

import tempfile
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.nets import ETANetwork
from torchdyn_plan.planners import CallablePlanner
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.wait_and_drop import waiting_search
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.train import train

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


def main(
    *, sequences: int = 16, num_envs: int = 16, steps: int = 40, episodes: int = 4, out: Path | None = None
) -> None:
    """Collect, fit, evaluate at 3 m/s."""
    task, static = load_task("trapper"), CallablePlanner(drive, in_keys=("joint_pos", "goal"))
    with tempfile.TemporaryDirectory() as name:
        data, threads = Path(name), {"num_envs": num_envs, "num_threads": 1}
        collect(task, "arrivals", data, episodes=sequences, planner=static, name="mj_jac", **threads)
        eta = ETANetwork.from_pretrained(train(task, "eta", data, data, steps=steps))
    corner, ours = task.planner("corner", "ik"), task.planner("wait_and_drop", "ik")
    planners = {
        "corner, ik": corner,
        "corner, mj_jac": corner.with_parts(static=static, eta=eta),
        "wait_and_drop, ik": ours,
        "wait_and_drop, mj_jac": ours.with_parts(
            static=static, eta=eta, search=waiting_search(TrapperScene(), by_probability=False)
        ),
    }
    found = evaluate(task, planners, static="ik", velocity=3.0, episodes=episodes, num_envs=500)
    print(found.table())
    if out is not None:
        found.save(out)


if __name__ == "__main__":
    tyro.cli(main)
