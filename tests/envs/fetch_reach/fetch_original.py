"""gymnasium-robotics' own FetchReach, mended for the mujoco that is installed."""

import contextlib
import io

import numpy as np


def original_fetch_reach():
    """FetchReach-v4; its helpers ask whether a numpy integer is in a tuple of enum members, which it never is."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        from gymnasium_robotics.envs.fetch.reach import MujocoFetchReachEnv
        from gymnasium_robotics.utils import mujoco_utils

    def put(field):
        return lambda _model, data, name, value: setattr(data.joint(name), field, value)

    def get(field):
        return lambda _model, data, name: np.array(getattr(data.joint(name), field))

    for field in ("qpos", "qvel"):
        setattr(mujoco_utils, f"set_joint_{field}", put(field))
        setattr(mujoco_utils, f"get_joint_{field}", get(field))
    return MujocoFetchReachEnv()
