"""The other side of `air_hockey.py`: the Robot Air Hockey Challenge, in an environment of its own, over a pipe.

    python air_hockey_side.py 3dof-defend [FOLDER]

Lines of JSON come in and go out. FOLDER holds the organisers' repository, of which the baseline agent is taken. It
needs fancy-gym and mushroom-rl, and knows nothing of torchdyn_plan.
"""

from __future__ import annotations

import base64
import json
import os
import sys
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

SERIES = {"dev": 0, "test": 1}
ROBOTS = {
    3: ("planar/planar_robot_1.xml", "planar_robot_1/base", "planar_robot_1/body_ee"),
    7: ("iiwas/iiwa_only.xml", "iiwa_1/base", "iiwa_1/striker_joint_link"),
}
"""Of an arm of so many joints: its file, and the bodies of its base and of its mallet."""
VIEWS = {"defend": (-0.35, 2.3), "hit": (-0.05, 2.9)}
"""Of a task: where along the table the camera looks, and from how far [m]."""


class Side:
    """One environment, and what it tells of an episode: what is seen, whether it is over, and what was violated."""

    def __init__(self, name: str, repository: str | None) -> None:
        """Make the environment ``name``."""
        build_agent: Any = None
        if repository is not None:
            # It asks matplotlib for windows, which fails once the environment's package has begun to plot.
            sys.path.insert(0, repository)
            from baseline.baseline_agent.baseline_agent import build_agent
        from fancy_gym.envs.mujoco.air_hockey import data
        from fancy_gym.envs.mujoco.air_hockey.air_hockey_env_wrapper import AirHockeyEnv

        self.env: Any = AirHockeyEnv(name)
        self.about: dict[str, Any] = self.env.env_info
        self.data = Path(data.__file__).parent
        self.agent: Any = None if build_agent is None else build_agent(self.about)
        self.step_number = 0

    def describe(self) -> dict[str, Any]:
        """Sizes [m], limits [rad; rad/s; rad/s²] and the arm's file."""
        robot, (file, base, mallet) = self.about["robot"], ROBOTS[self.about["robot"]["n_joints"]]
        return {
            "file": str(self.data / file),
            "base": base,
            "mallet": mallet,
            "base_x": float(robot["base_frame"][0][0, 3]),
            "height": float(robot["ee_desired_height"]),
            "joint_pos": robot["joint_pos_limit"].tolist(),
            "joint_vel": robot["joint_vel_limit"][1].tolist(),
            "joint_acc": robot["joint_acc_limit"][1].tolist(),
            "length": self.about["table"]["length"],
            "width": self.about["table"]["width"],
            "goal_width": self.about["table"]["goal_width"],
            "puck_radius": self.about["puck"]["radius"],
            "mallet_radius": self.about["mallet"]["radius"],
            "control_step": float(self.about["dt"]),
            "steps": int(self.env.info.horizon),
        }

    def reset(self, series: str, episode: int) -> dict[str, Any]:
        """Begin an episode, the same whenever it is asked for."""
        # The environment draws from it; its own reset would seed it anew.
        np.random.seed([SERIES[series], episode])
        self.seen = self.env.base_env.reset()
        self.step_number = 0
        return self._seen()

    def step(self, joint_pos: list[float], joint_vel: list[float]) -> dict[str, Any]:
        """One control step, with what the joints are to be and to move at its end."""
        self.seen, _, done, _, about = self.env.step(np.array([joint_pos, joint_vel]))
        self.step_number += 1
        violated = [name for name, value in about["constraints_value"].items() if bool(np.any(value > 0.0))]
        over = bool(done) or self.step_number >= self.env.info.horizon
        return self._seen() | {"over": over, "success": bool(about["success"]), "violated": violated}

    def baseline(self, series: str, episode: int) -> dict[str, Any]:
        """A whole episode of the organisers' agent: its outcome, and wall and processor time of each action [ms]."""
        self.reset(series, episode)
        self.agent.episode_start()
        milliseconds: list[list[float]] = []
        violated: set[str] = set()
        while True:
            begun = time.perf_counter(), time.process_time()
            action = self.agent.draw_action(self.seen)
            taken = time.perf_counter() - begun[0], time.process_time() - begun[1]
            milliseconds.append([1e3 * seconds for seconds in taken])
            told = self.step(*action.tolist())
            violated.update(told["violated"])
            if told["over"]:
                break
        return {"success": told["success"], "violated": sorted(violated), "milliseconds": milliseconds}

    def picture(self, width: int, height: int) -> str:
        """What a camera above the near end sees, RGB row by row, in base64."""
        import mujoco

        base = self.env.base_env
        camera = mujoco.MjvCamera()
        along, camera.distance = VIEWS[self.env.env_name.split("-")[1]]
        camera.lookat[:], camera.azimuth, camera.elevation = (along, 0.0, 0.0), 0.0, -55.0
        if not hasattr(self, "renderer"):
            self.renderer = mujoco.Renderer(base._model, height, width)
        self.renderer.update_scene(base._data, camera)
        return base64.b64encode(self.renderer.render().tobytes()).decode()

    def _seen(self) -> dict[str, Any]:
        names = ("puck_pos", "puck_vel", "joint_pos", "joint_vel")
        return {name: self.seen[self.about[f"{name}_ids"]].tolist() for name in names}


def serve(name: str, repository: str | None) -> None:
    """Answer line by line."""
    answers = os.fdopen(os.dup(1), "w")
    # Nothing else may come between the answers.
    os.dup2(2, 1)
    warnings.simplefilter("ignore")
    answer = partial(print, file=answers, flush=True)
    side = Side(name, repository)
    answer(json.dumps(side.describe()))
    for line in sys.stdin:
        method, arguments = json.loads(line)
        answer(json.dumps(getattr(side, method)(*arguments)))


if __name__ == "__main__":
    serve(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None)
