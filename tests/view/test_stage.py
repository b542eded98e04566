import mujoco
import numpy as np
import pytest
import torch

from tests.envs.worlds import WORLDS
from torchdyn_plan.envs.look import Look, bare_floor
from torchdyn_plan.envs.painter import Painter
from torchdyn_plan.tasks import load_task, task_names
from torchdyn_plan.view.stage import body_meshes, camera_of, places_of, with_plain_colours

FLOOR = bare_floor(1.0)


@pytest.mark.parametrize("name", ["points", "trapper", "reach"])
def test_every_world_has_a_look_and_a_posture(name):
    """What moves in the world moves in its model; a ball stands for what is not there."""
    if name.startswith("reach"):
        pytest.importorskip("gymnasium_robotics")
    env = WORLDS[name]()
    seen, look = env.reset(), env.look()
    before = env.posture(0)
    assert before.shape == (look.model.nq,)
    if name == "points":
        assert look.tool is not None
        return
    assert look.tool is None
    env.step(seen.set("action", torch.ones_like(env.action_spec.rand())))
    assert not np.array_equal(before, env.posture(0))
    before[:] = np.nan
    assert np.isfinite(env.posture(0)).all()


@pytest.mark.parametrize("name", task_names())
def test_every_task_can_be_drawn(name, monkeypatch):
    """A task with a MuJoCo model draws its pictures by the look that it tells."""
    task = load_task(name)
    if name.startswith("fetch"):
        pytest.importorskip("gymnasium_robotics")
    env = task.make_env(task.default_settings(), num_envs=1, seed=0, split="dev", num_threads=1)
    env.reset()
    drawn = []
    monkeypatch.setattr(Painter, "picture", lambda self, posture, *_: drawn.append((self.model, posture)))
    look = env.look()
    assert env.posture(0).shape == (look.model.nq,)
    if look.tool is None:
        env._picture(0, 8, 8)
        ((model, posture),) = drawn
        assert model.nq == look.model.nq
        np.testing.assert_array_equal(posture, env.posture(0))


def test_every_body_that_can_be_seen_has_a_mesh_where_it_is():
    pytest.importorskip("mjviser")
    spec = mujoco.MjSpec()
    for name, group, alpha in (("seen", 0, 1.0), ("collision", 3, 1.0), ("glass", 0, 0.0)):
        body = spec.worldbody.add_body(name=name, pos=[1.0, 0.0, 0.0])
        size = [0.1, 0.2, 0.3]
        box = mujoco.mjtGeom.mjGEOM_BOX
        body.add_geom(type=box, size=size, pos=[0.0, 0.0, 0.5], group=group, rgba=[1.0, 0.0, 0.0, alpha])
    found = body_meshes(spec.compile())
    (mesh,) = found.values()
    assert list(found) == [1]
    np.testing.assert_allclose(mesh.bounds, [[-0.1, -0.2, 0.2], [0.1, 0.2, 0.8]])


def test_textures_become_their_mean_colour():
    before = FLOOR.mat_rgba.copy()
    mean = with_plain_colours(FLOOR).mat_rgba[0, :3]
    assert (mean < before[0, :3]).all()
    assert mean.min() > 0.7
    np.testing.assert_array_equal(FLOOR.mat_rgba, before)


def test_the_camera_stands_where_mujoco_puts_it():
    look = Look(FLOOR, lookat=(0.1, -0.2, 0.3), distance=2.0, azimuth=150.0, elevation=-40.0)
    place, lookat, right = camera_of(look)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = look[1], 2.0, 150.0, -40.0
    scene = mujoco.MjvScene(FLOOR, maxgeom=10)
    data, option = mujoco.MjData(FLOOR), mujoco.MjvOption()
    mujoco.mj_forward(FLOOR, data)
    mujoco.mjv_updateScene(FLOOR, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
    eyes = np.mean([np.array(eye.pos) for eye in scene.camera], axis=0)
    np.testing.assert_allclose(place, eyes, atol=1e-5)
    forward = np.array(scene.camera[0].forward)
    np.testing.assert_allclose((lookat - place) / 2.0, forward, atol=1e-5)
    np.testing.assert_allclose(right, np.cross(forward, scene.camera[0].up), atol=1e-5)


def test_worlds_stand_side_by_side():
    look = Look(FLOOR, half_side=0.5)
    one = places_of(look, 1)
    left, second = places_of(look, 2)
    np.testing.assert_allclose(one, [[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(left, -second)
    assert np.linalg.norm(second - left) == pytest.approx(1.5)
    assert (second - left) @ camera_of(look)[2] > 0.0
