# mujoco hides its names from type checkers.
# pyright: reportAttributeAccessIssue=false
"""N copies of gymnasium-robotics' Fetch arm, stepped on native threads as its FetchReach steps one."""

from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from torchdyn_plan.errors import InputError

ARM_JOINTS = (
    "shoulder_pan",
    "shoulder_lift",
    "upperarm_roll",
    "elbow_flex",
    "forearm_roll",
    "wrist_flex",
    "wrist_roll",
)
"""Joints of the arm, base to tool."""
FINGERS = ("r_gripper_finger", "l_gripper_finger")
SUBSTEPS = 20
"""Simulation steps of 2 ms in a control step."""
CONTROL_STEP = 0.04
"""Time between two actions [s]."""
LONGEST_PULL = 0.05
"""How far from the gripper an action of 1 pulls it along an axis [m]; the arm covers about two thirds of it."""
_BASE = {"slide0": 0.4049, "slide1": 0.48, "slide2": 0.0}
"""Where FetchReach puts the robot's base [m]."""
_FIRST_PULL = (-0.498, 0.005, -0.231)
"""Where FetchReach pulls the gripper before the first episode, from where the model has it [m]."""
_DOWN = (1.0, 0.0, 1.0, 0.0)
"""Orientation of a gripper that points down, as FetchReach adds it to the present one (wxyz, not normalised)."""


def fetch_model_path() -> Path:
    """The model file of FetchReach in the installed gymnasium-robotics; `InputError` if that is not installed."""
    package = importlib.util.find_spec("gymnasium_robotics")
    folders = [] if package is None else list(package.submodule_search_locations or [])
    files = [Path(folder) / "envs" / "assets" / "fetch" / "reach.xml" for folder in folders]
    if not files or not files[0].is_file():
        raise InputError("the Fetch model needs its extra: pip install 'torchdyn-plan[reach]'")
    return files[0]


def fetch_digest() -> str:
    """Hash of the model's files: what data and networks of Fetch belong to."""
    content = hashlib.sha256()
    for name in ("reach.xml", "robot.xml", "shared.xml"):
        content.update((fetch_model_path().parent / name).read_bytes())
    return content.hexdigest()[:16]


def compile_fetch() -> mujoco.MjModel:
    """FetchReach's model with the gripper's velocity as a sensor, its weld set as FetchReach sets it."""
    spec = mujoco.MjSpec.from_file(str(fetch_model_path()))
    spec.add_sensor(
        name="grip_velocity",
        type=mujoco.mjtSensor.mjSENS_FRAMELINVEL,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname="robot0:grip",
    )
    model = spec.compile()
    model.eq_data[0, :7] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    # One robot is one island of constraints: looking for more costs a twentieth of the time and changes nothing.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND.value
    return model


class Start(NamedTuple):
    """State of the arm at the start of every episode."""

    qpos: Tensor
    """``(nq,)`` generalised positions."""
    qvel: Tensor
    """``(nv,)`` generalised velocities: FetchReach does not wait until the arm is quite at rest."""
    tool_pos: Tensor
    """``(3,)`` of the gripper, which goals are drawn around [m, world]."""


def settle(model: mujoco.MjModel) -> Start:
    """Pull the gripper to its first place for ten control steps, as FetchReach does when it is built."""
    data = mujoco.MjData(model)
    for name, value in _BASE.items():
        data.joint(f"robot0:{name}").qpos = value
    mujoco.mj_forward(model, data)
    data.mocap_pos[0] = data.site("robot0:grip").xpos + np.array(_FIRST_PULL)
    data.mocap_quat[0] = _DOWN
    for _ in range(10):
        mujoco.mj_step(model, data, nstep=SUBSTEPS)
    # FetchReach reads the gripper's place here, one substep behind the state.
    place = data.site("robot0:grip").xpos
    return Start(torch.tensor(data.qpos), torch.tensor(data.qvel), torch.tensor(place))


class FetchSimulation:
    """Arms of ``num_envs`` Fetch robots. All tensors are float64 on the CPU.

    ``tool_pos`` (N, 3) [m, world], ``tool_vel`` (N, 3) [m/s], ``joint_pos`` and ``joint_vel`` (N, 7) [rad, rad/s],
    ``finger_pos`` and ``finger_vel`` (N, 2) [m, m/s] are copies, made at each reading.
    """

    def __init__(self, num_envs: int, *, num_threads: int = 0) -> None:
        """Compile the model and build the batch; ``num_threads`` 0 means all cores."""
        self.num_envs, self.model = num_envs, compile_fetch()
        self.start = settle(self.model)
        self.batch = Batch(self.model, num_envs, num_threads)
        self.qpos, self._qvel, self._pull, self._turn = (
            torch.from_numpy(self.batch.bind(name)) for name in ("qpos", "qvel", "mocap_pos", "mocap_quat")
        )
        self._xpos, self._xquat, self._site, self._sensor = map(
            self.batch.bind, ("xpos", "xquat", "site_xpos", "sensordata")
        )
        model = self.model
        self._gripper, self._grip = model.body("robot0:gripper_link").id, model.site("robot0:grip").id
        self._arm = [int(model.joint(f"robot0:{name}_joint").qposadr[0]) for name in ARM_JOINTS]
        self._fingers = [int(model.joint(f"robot0:{name}_joint").qposadr[0]) for name in FINGERS]
        self.reset(torch.arange(num_envs))

    @property
    def tool_pos(self) -> Tensor:
        """Places of the grippers, ``(N, 3)`` [m, world]."""
        return torch.tensor(self._site[:, self._grip])

    @property
    def tool_vel(self) -> Tensor:
        """Velocities of the grippers, ``(N, 3)`` [m/s, world]."""
        return torch.tensor(self._sensor)

    @property
    def joint_pos(self) -> Tensor:
        """Joint angles of the arms, ``(N, 7)`` [rad]."""
        return self.qpos[:, self._arm]

    @property
    def joint_vel(self) -> Tensor:
        """Joint speeds of the arms, ``(N, 7)`` [rad/s]."""
        return self._qvel[:, self._arm]

    @property
    def robot_state(self) -> Tensor:
        """FetchReach's observation, ``(N, 10)``: gripper, fingers, and both velocities [m, m per control step]."""
        fingers, speeds = self.qpos[:, self._fingers], self._qvel[:, self._fingers]
        return torch.cat([self.tool_pos, fingers, self.tool_vel * CONTROL_STEP, speeds * CONTROL_STEP], dim=-1)

    def reset(self, rows: Tensor) -> None:
        """Put the arms ``rows`` (M,) back to the start."""
        if len(rows):
            ids = rows.numpy()
            self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
            self.qpos[rows], self._qvel[rows] = self.start.qpos, self.start.qvel
            self.batch.forward(ids)

    def step(self, action: Tensor, rows: Tensor | None = None) -> None:
        """One control step of ``rows``, all by default; fingers stay shut.

        ``action`` (N, 3 or 4) within ±1 pulls each gripper along x, y and z.
        """
        ids = None if rows is None else rows.numpy()
        pull = action[:, :3].to(torch.float64).clamp(-1.0, 1.0) * LONGEST_PULL
        self._pull[:, 0] = torch.tensor(self._xpos[:, self._gripper]) + pull
        self._turn[:, 0] = torch.tensor(self._xquat[:, self._gripper]) + torch.tensor(_DOWN, dtype=torch.float64)
        self.batch.step(ids, nstep=SUBSTEPS)
        self.qpos[:, self._fingers] = 0.0
        # Forces are not read: the next step computes them.
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL.value)
