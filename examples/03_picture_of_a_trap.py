"""Draw a trap: the ball's true path (yellow), the forecast at the last re-plan (blue) and the goal (red).

MUJOCO_GL=egl python examples/03_picture_of_a_trap.py trap.png
"""

import sys
from itertools import pairwise

import mujoco
import numpy as np
import torch
from matplotlib.image import imsave
from torchrl.envs.utils import step_mdp

from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.planners import DynamicPlanner

YELLOW, BLUE, RED = (0.98, 0.80, 0.15, 1.0), (0.20, 0.45, 0.95, 1.0), (0.90, 0.15, 0.12, 1.0)


def draw_line(scene: mujoco.MjvScene, points: np.ndarray, colour: tuple[float, ...], width: float) -> None:
    """Add a polyline through ``points`` (n, 3) [m] to a scene that is about to be drawn."""
    for start, end in pairwise(points):
        geom = scene.geoms[scene.ngeom]
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.array(colour, np.float32))
        mujoco.mjv_connector(geom, kind, width, start, end)
        scene.ngeom += 1


def draw_ball(scene: mujoco.MjvScene, place: np.ndarray, colour: tuple[float, ...], radius: float) -> None:
    """Add a sphere at ``place`` (3,) [m]."""
    geom, size, kind = scene.geoms[scene.ngeom], np.full(3, radius), mujoco.mjtGeom.mjGEOM_SPHERE
    mujoco.mjv_initGeom(geom, kind, size, place, np.eye(3).ravel(), np.array(colour, np.float32))
    scene.ngeom += 1


def run(env: TrapperEnv, planner: DynamicPlanner, episode: int) -> tuple[bool, list[np.ndarray], list[np.ndarray]]:
    """Whether the ball of ``episode`` is trapped, and at each step the scene's ``qpos`` and what is to be drawn."""
    env.start_from(episode)
    state, scenes, meetings, forecast = env.reset(), [], [], np.zeros((1, 3))
    while True:
        state = planner(state)
        if state["plan", "replanned"][0]:
            ahead = planner.forecaster(state["target_history"])[0, : int(state["arrival_steps"][0]) + 1]
            forecast = torch.cat([state["target_pos"], ahead]).numpy()
        scenes.append(env.simulation.qpos[0].numpy().copy())
        meetings.append(np.concatenate([forecast, state["goal"].numpy()]))
        state = env.step(state)
        if state["next", "done"][0]:
            return bool(state["next", "trapped"][0]), scenes, meetings
        state = step_mdp(state)


def main(file: str, before: int = 200) -> None:
    """Draw the first trap that comes after a bounce and a long way, ``before`` steps before it."""
    env, planner = TrapperEnv(1, velocity=3.0, split="dev", seed=0), DynamicPlanner.from_pretrained("trapper-ik")
    for episode in range(100):
        trapped, scenes, meetings = run(env, planner, episode)
        path = np.array(scenes)[:, :3]
        if trapped and len(path) > 260 and np.ptp(path[:, :2], axis=0).min() > 0.5:
            break
    model = env.simulation.model
    data = mujoco.MjData(model)
    data.qpos[:] = scenes[-before]
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.0, 0.0, -0.1), 2.7, 150.0, -48.0
    with mujoco.Renderer(model, 720, 1280) as renderer:
        renderer.update_scene(data, camera)
        draw_line(renderer.scene, path[: len(path) - before : 4], YELLOW, 0.008)
        draw_line(renderer.scene, meetings[-before][:-1:4], BLUE, 0.008)
        draw_ball(renderer.scene, meetings[-before][-1], RED, 0.025)
        imsave(file, renderer.render())


if __name__ == "__main__":
    torch.set_num_threads(1)
    with torch.no_grad():
        main(sys.argv[1] if len(sys.argv) > 1 else "trap.png")
