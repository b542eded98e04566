"""Other libraries' kinematics of the UR5, in the form in which the benchmark times them; the extra ``bench`` has them.

Each is given numbers as it likes them best, before the clock runs. Libraries that are not installed are left out.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.kinematics.ur5 import UR5_LINKS, ur5_urdf

Solve = Callable[[], Any]
"""What is timed."""

DAMPING = 0.02
"""λ of every library's damped least squares."""


class PytorchKinematics:
    """Its Jacobian with the pose, and its solver by damped pseudo-inverse, in float32."""

    name, most = "pytorch-kinematics", 65536

    def __init__(self) -> None:
        """Parse the UR5."""
        import pytorch_kinematics as pk

        self.pk: Any = pk
        self.chain: Any = pk.SerialChain(pk.build_chain_from_urdf(ur5_urdf().encode()), "tool")

    def pose_and_jacobian(self, q: Tensor) -> Solve:
        """One call for the batch."""
        return lambda: self.chain.jacobian(q, ret_eef_pose=True)[::-1]

    def steps(self, q: Tensor, target: Tensor) -> Solve:
        """`PseudoInverseIK` of five iterations."""
        goal = self.pk.Transform3d(matrix=target)
        solver = self._solver(q.unsqueeze(1), iterations=5, tolerances=(1e-9, 1e-9))

        def solve() -> Tensor:
            solver.initial_config = q.reshape(len(q), 1, 6)
            # It keeps solutions of rows that converged alone; err_all and the last angles are what five steps reach.
            return solver.solve(goal).solutions[:, 0]

        return solve

    def _solver(self, starts: Tensor, *, iterations: int, tolerances: tuple[float, float]) -> Any:
        return self.pk.PseudoInverseIK(
            self.chain,
            max_iterations=iterations,
            retry_configs=starts[0],
            num_retries=starts.shape[1],
            pos_tolerance=tolerances[0],
            rot_tolerance=tolerances[1],
            early_stopping_no_improvement=None,
            enforce_joint_limits=False,
            lr=1.0,
            lm_damping=0.0,
            regularlization=DAMPING**2,
        )


class Pinocchio:
    """Its frame Jacobian and pose, row by row, and numpy's solve of the damped normal equations, in float64."""

    name, most = "pinocchio", 1024

    def __init__(self) -> None:
        """Parse the UR5."""
        self.pin: Any = importlib.import_module("pinocchio")
        self.np: Any = importlib.import_module("numpy")
        self.model = self.pin.buildModelFromXML(ur5_urdf())
        self.data, self.frame = self.model.createData(), self.model.getFrameId("tool")

    def pose_and_jacobian(self, q: Tensor) -> Solve:
        """A loop over the rows."""
        rows = q.double().numpy()
        return lambda: list(zip(*map(self._evaluate, rows), strict=True))

    def steps(self, q: Tensor, target: Tensor) -> Solve:
        """A loop over the rows."""
        pairs = list(zip(q.double().numpy(), target.double().numpy(), strict=True))
        return lambda: [self._five(*pair) for pair in pairs]

    def _evaluate(self, q: Any) -> tuple[Any, Any]:
        jacobian = self.pin.computeFrameJacobian(self.model, self.data, q, self.frame, self.pin.LOCAL_WORLD_ALIGNED)
        return self.data.oMf[self.frame].homogeneous, jacobian

    def _five(self, q: Any, target: Any) -> Any:
        np, ridge = self.np, DAMPING**2 * self.np.eye(6)
        for _ in range(5):
            pose, jacobian = self._evaluate(q)
            turn = self.pin.log3(target[:3, :3] @ pose[:3, :3].T)
            error = np.concatenate([target[:3, 3] - pose[:3, 3], turn])
            q = q + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + ridge, error)
        return q


class Mink:
    """Its frame task over MuJoCo, solved as quadratic programs by daqp, row by row, in float64."""

    name, most = "mink", 64

    def __init__(self) -> None:
        """Build the UR5 in MuJoCo."""
        self.mink: Any = importlib.import_module("mink")
        importlib.import_module("daqp")
        mujoco: Any = importlib.import_module("mujoco")
        self.configuration = self.mink.Configuration(mujoco.MjModel.from_xml_string(_mjcf()))

    def pose_and_jacobian(self, q: Tensor) -> Solve:
        """A loop over the rows."""
        rows = q.double().numpy()
        return lambda: list(zip(*map(self._evaluate, rows), strict=True))

    def steps(self, q: Tensor, target: Tensor) -> Solve:
        """A loop over the rows."""
        task = self.mink.FrameTask("tool", "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-6)
        goals = [self.mink.SE3.from_matrix(matrix) for matrix in target.double().numpy()]
        pairs = list(zip(q.double().numpy(), goals, strict=True))
        return lambda: [self._five(task, *pair) for pair in pairs]

    def _evaluate(self, q: Any) -> tuple[Any, Any]:
        self.configuration.update(q)
        place = self.configuration.get_transform_frame_to_world("tool", "site")
        # Mink's Jacobian is in the tool's frame.
        jacobian, turn = self.configuration.get_frame_jacobian("tool", "site"), place.rotation().as_matrix()
        jacobian[:3], jacobian[3:] = turn @ jacobian[:3], turn @ jacobian[3:]
        return place.as_matrix(), jacobian

    def _five(self, task: Any, q: Any, goal: Any) -> Any:
        task.set_target(goal)
        self.configuration.update(q)
        for _ in range(5):
            velocity = self.mink.solve_ik(self.configuration, [task], 1.0, solver="daqp", damping=DAMPING**2, limits=[])
            self.configuration.integrate_inplace(velocity, 1.0)
        return self.configuration.q.copy()


class Eaik:
    """All analytic solutions of each row, of which the first exact one is taken, in float64."""

    name = "EAIK"

    def __init__(self) -> None:
        """Decompose the UR5."""
        self.np: Any = importlib.import_module("numpy")
        columns = ([getattr(link, key) for link in UR5_LINKS] for key in ("alpha", "a", "d"))
        self.robot: Any = importlib.import_module("eaik.IK_DH").DhRobot(*map(self.np.array, columns))

    def solve(self, target: Tensor) -> Solve:
        """A loop over the rows; not a number where there is no solution."""
        rows, none = target.double().numpy(), self.np.full(6, math.nan)

        def solve() -> Tensor:
            found = [self.robot.IK(row) for row in rows]
            # Those that are least squares alone do not reach the target.
            exact = [one.Q[self.np.argmin(one.is_LS)] if len(one.Q) else none for one in found]
            return torch.from_numpy(self.np.stack(exact))

        return solve


def installed(kinds: Sequence[type]) -> list[Any]:
    """One of each kind whose library is there."""
    found = []
    for kind in kinds:
        try:
            found.append(kind())
        except ImportError:
            continue
    return found


def _mjcf() -> str:
    """MJCF text of the UR5 alone."""
    text, place, roll = "", "0 0 0", 0.0
    for link in UR5_LINKS:
        quaternion = f"{math.cos(roll / 2)!r} {math.sin(roll / 2)!r} 0 0"
        text += f'<body pos="{place}" quat="{quaternion}"><joint name="{link.joint}"/><geom size="0.01"/>'
        place, roll = f"{link.a!r} 0 {link.d!r}", link.alpha
    site = f'<site name="tool" pos="{place}" quat="{math.cos(roll / 2)!r} {math.sin(roll / 2)!r} 0 0"/>'
    return f"<mujoco><worldbody>{text}{site}{'</body>' * len(UR5_LINKS)}</worldbody></mujoco>"
