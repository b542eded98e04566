"""TorchRL's own UR5e, whose macro actions `ArmSolver` solves: above the cube, straight down, straight up again.

git clone --depth 1 https://github.com/google-deepmind/mujoco_menagerie
python examples/torchrl_arm.py --menagerie mujoco_menagerie
"""

import argparse
import time
from pathlib import Path

import torch
from torchrl.envs import CubeBowlEnv, RobotMacroAction, URScriptPrimitiveTransform

from torchdyn_plan.kinematics import Arm, ArmSolver

parser = argparse.ArgumentParser()
parser.add_argument("--menagerie", type=Path, required=True, help="a checkout of MuJoCo's Menagerie, which has the arm")
arguments = parser.parse_args()
torch.set_num_threads(1)
STEPS, SETTLE = 20, 150
"""Actions of a macro action along its way, and after it."""


def rotation(quaternion: torch.Tensor) -> torch.Tensor:
    """Rotation (3, 3) of a unit quaternion wxyz."""
    w, vector = quaternion[0], quaternion[1:]
    cross = torch.linalg.cross(vector.expand(3, 3), torch.eye(3)).T
    return torch.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


env = CubeBowlEnv(menagerie_path=arguments.menagerie)
seen = env.reset()
arm = Arm.from_mjcf(arguments.menagerie / "universal_robots_ur5e" / "ur5e.xml", tip="site:attachment_site")
# The point between the fingers, where the environment sees it at the start.
pinch = torch.eye(4)
pinch[:3, :3], pinch[:3, 3] = rotation(seen["pinch_quat"][0]), seen["pinch_pos"][0]
tool = torch.linalg.inv(arm(seen["robot_qpos"][0])) @ pinch
turn, _, other = torch.linalg.svd(tool[:3, :3])
tool[:3, :3], tool[3] = turn @ other, torch.tensor([0.0, 0.0, 0.0, 1.0])
arm = Arm.from_mjcf(arguments.menagerie / "universal_robots_ur5e" / "ur5e.xml", tip="site:attachment_site", tool=tool)
solver = ArmSolver(arm)
macro = URScriptPrimitiveTransform(
    cartesian_solver=solver, execute=True, open_gripper_ctrl=env.gripper_open_ctrl, close_gripper_ctrl=255.0
)
driven = env.append_transform(macro)

cube = seen["cube_pos"].clone()
for name, height, path in (("above", 0.2, "joint"), ("down", 0.12, "cartesian"), ("up", 0.2, "cartesian")):
    place = cube + torch.tensor([0.0, 0.0, height])
    seen["action"] = RobotMacroAction.reach_pose(
        position=place,
        quaternion=seen["pinch_quat"],
        orientation_mask=(1.0, 1.0, 0.0),  # the gripper stays upright, and may turn about the vertical
        path=path,
        gripper="open",
        steps=STEPS,
        settle_steps=SETTLE,
    )
    seen = driven.step(seen)["next"].exclude("reward")
    off = 1e3 * float((seen["pinch_pos"] - place).norm())
    level = float(rotation(seen["pinch_quat"][0])[2, 2])
    print(f"{name:5s} the pinch is {off:.1f} mm from where it should be, its axis upright to {1.0 + level:.5f}")

start = torch.cat([seen["robot_qpos"], torch.zeros(1, 1)], dim=-1).expand(1000, -1)
goals = torch.cat([cube + 0.2 * torch.rand(1000, 3), seen["pinch_quat"].expand(1000, -1)], dim=-1)
begin = time.perf_counter()
solved = solver.solve(goals, start).status == 0
print(f"{int(solved.sum())} of 1000 poses solved at once in {1e3 * (time.perf_counter() - begin):.0f} ms")
begin = time.perf_counter()
for goal in goals[:20]:
    env._cartesian_pose_to_joint_target(goal.unsqueeze(0), start[:1], orientation_weight=1.0)
print(f"TorchRL's own solver takes {1e3 * (time.perf_counter() - begin) / 20:.0f} ms for one")
