import dataclasses
import math

import mujoco
import pytest
import torch

from torchdyn_plan.envs import TrapperScene, TrapperSimulation
from torchdyn_plan.envs.trapper.contact import is_pocketed
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import UR5_LINKS

SCENE = TrapperScene()
FIELDS = [field.name for field in dataclasses.fields(TrapperScene)]
LENGTHS = [name for name in FIELDS if isinstance(getattr(SCENE, name), float) and name not in (
    "rolling_resistance", "base_height")]  # fmt: skip
QUARTER = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)
MIRROR = torch.tensor([[-1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)


def changed(value):
    return tuple(changed(item) for item in value) if isinstance(value, tuple) else value * 1.001


def symmetries():
    """The eight symmetries of the square, (2, 2) each."""
    turns = [torch.linalg.matrix_power(QUARTER, k) for k in range(4)]
    return [*turns, *(turn @ MIRROR for turn in turns)]


def roll(place, velocity, steps):
    """Paths of balls alone, (M, T, 3)."""
    simulation = TrapperSimulation(len(place), SCENE, num_threads=1, arm=False)
    simulation.reset(torch.arange(len(place)), place, velocity)
    path = []
    for _ in range(steps):
        simulation.step()
        path.append(simulation.ball_pos.clone())
    return torch.stack(path, dim=1)


def pockets():
    """Middles of the eight pockets on the cushion line and their outward directions, (8, 2) each."""
    middle = torch.tensor([[SCENE.pocket_offset, SCENE.half_side], [-SCENE.pocket_offset, SCENE.half_side]])
    turns = torch.stack([torch.linalg.matrix_power(QUARTER, k) for k in range(4)])
    outward = turns @ torch.tensor([0.0, 1.0], dtype=torch.float64)
    return torch.einsum("kij,mj->kmi", turns, middle.double()).reshape(8, 2), outward.repeat_interleave(2, dim=0)


@pytest.mark.parametrize("speed", [0.6, 2.0, 5.0])
def test_each_of_eight_pockets_swallows_a_ball_aimed_at_it(speed):
    middle, outward = pockets()
    assert len({tuple(place) for place in middle.round(decimals=6).tolist()}) == 8
    path = roll(middle - 0.3 * outward, speed * outward, 250)
    inside = is_pocketed(SCENE, path)
    assert inside[:, -1].all()
    entry = path[torch.arange(8), inside.int().argmax(dim=1), :2] - middle
    assert entry.norm(dim=-1).max() < SCENE.pocket_gap / 2 + SCENE.rail_width


def test_a_ball_aimed_at_a_rail_is_not_swallowed():
    _, outward = pockets()
    path = roll(0.5 * outward, 2.0 * outward, 250)
    assert not is_pocketed(SCENE, path).any()
    assert path[..., :2].abs().max() < SCENE.half_side


def test_the_table_is_the_same_from_all_sides_and_in_the_mirror():
    random = torch.Generator().manual_seed(0)
    place, velocity = torch.rand(2, 24, 2, generator=random, dtype=torch.float64) * 2 - 1
    place = place * (SCENE.half_side - 2 * SCENE.ball_radius)
    expected = roll(place, 3 * velocity, 150)
    for symmetry in symmetries():
        path = roll(place @ symmetry.T, 3 * velocity @ symmetry.T, 150)
        torch.testing.assert_close(path[..., :2], expected[..., :2] @ symmetry.T, atol=1e-6, rtol=0)
        torch.testing.assert_close(path[..., 2], expected[..., 2], atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", FIELDS)
def test_the_digest_changes_with_every_field(name):
    other = dataclasses.replace(SCENE, **{name: changed(getattr(SCENE, name))})
    assert other.digest() != SCENE.digest()
    assert TrapperScene().digest() == SCENE.digest()


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, 0.0])
@pytest.mark.parametrize("name", LENGTHS)
def test_impossible_numbers_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        TrapperScene(**{name: value})


def test_an_unknown_field_is_refused_and_none_can_be_changed():
    with pytest.raises(TypeError, match="table_length"):
        TrapperScene(table_length=1.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        SCENE.table_side = 2.0


@pytest.mark.parametrize("friction", [-1.0, math.nan])
def test_impossible_friction_is_refused(friction):
    with pytest.raises(InputError, match="friction"):
        SCENE.compile(friction=friction)


def test_friction_brakes_the_balls_horizontal_translation_alone():
    model = SCENE.compile(friction=2.5)
    first = int(model.joint("ball").dofadr[0])
    expected = [0.0] * model.nv
    expected[first : first + 2] = [2.5, 2.5]
    assert model.dof_frictionloss.tolist() == expected


def test_the_home_pose_is_upright_above_the_table_and_touches_nothing():
    model = SCENE.compile()
    data = mujoco.MjData(model)
    data.qpos[[int(model.joint(link.joint).qposadr[0]) for link in UR5_LINKS]] = SCENE.home
    data.joint("ball").qpos[:3] = [0.0, SCENE.half_side - 2 * SCENE.ball_radius, SCENE.ball_radius]
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    place, axes = data.site("tool").xpos, data.site("tool").xmat.reshape(3, 3)
    assert place[2] > 2 * SCENE.ball_radius
    assert abs(place[:2]).max() < SCENE.half_side - SCENE.box_outer
    assert axes[2, 2] < -math.cos(0.01)


def test_the_box_is_hollow_and_as_wide_as_it_says():
    model = SCENE.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    site, flange = data.site("tool"), model.body("flange").id
    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == flange]
    assert float(model.body("flange").mass[0]) == pytest.approx(SCENE.box_mass)
    axes = site.xmat.reshape(3, 3)
    reach = []
    for g in geoms:
        middle = axes.T @ (data.geom_xpos[g] - site.xpos)
        low, high = middle - model.geom_size[g], middle + model.geom_size[g]
        reach.append((low, high))
    assert min(low[0] for low, _ in reach) == pytest.approx(-SCENE.box_outer)
    assert max(high[1] for _, high in reach) == pytest.approx(SCENE.box_outer)
    assert max(high[2] for _, high in reach) == pytest.approx(0.0, abs=1e-9)
    inside = SCENE.box_half_width - 1e-6
    for low, high in reach:
        wall = any(low[i] >= inside or high[i] <= -inside for i in (0, 1))
        assert wall or high[2] <= -SCENE.box_depth + 1e-9
