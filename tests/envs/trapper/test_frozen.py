"""What every published figure rests on. None of it may change, least of all to help a planner."""

import math

import mujoco
import numpy as np
import pytest
import torch

from torchdyn_plan.envs import TrapperScene, TrapperSimulation
from torchdyn_plan.envs.trapper.env import HOLD_STEPS, LAST_HOLD_STEPS, MAX_STEPS
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.errors import InputError

FROZEN = "this is frozen: with it changed, no result can be compared with an earlier one or with the paper"
SCENE = TrapperScene()
PLACES = [
    [0.20489468423289564, -0.34439907620925003],
    [-0.07593872705774526, -0.1630017090501495],
    [0.18332423948210627, -0.10876302701382941],
]
VELOCITIES = [
    [-2.7541588563828316, -2.9008341868288254],
    [0.4618127119268929, -1.2630061531336008],
    [1.2573683973268044, 2.3029513929652397],
]
BODIES = {
    "body_mass": -3.980228359574865,
    "body_inertia": 0.15161084801977157,
    "body_ipos": 0.034225418565524135,
    "body_pos": -0.8051201391447098,
    "dof_armature": -0.0022120904856580666,
    "jnt_range": 0.16015907417570655,
    "jnt_actfrcrange": 19.269792466197888,
    "actuator_gainprm": 3880.8626913326016,
    "actuator_biasprm": -3679.0199180610834,
    "actuator_forcerange": -27.077911203805076,
}
CONTACTS = {
    "geom_size": 1.1436648358172927,
    "geom_pos": 0.9387971815624623,
    "geom_friction": -0.2293765692232149,
    "geom_solref": 10205.601519888336,
    "geom_solimp": -1.242990799045819,
    "geom_condim": -3.7260602264130585,
    "geom_priority": 3.3256224639595846,
    "geom_contype": -5.982879106490919,
}


def weighted(values):
    """One number that changes with every entry and with their order."""
    flat = np.asarray(values, dtype=float).ravel()
    return float(flat @ np.sin(1 + np.arange(len(flat))))


def test_the_scene():
    assert SCENE.digest() == "cc49d789bb82e1c9", FROZEN
    assert (MAX_STEPS, HOLD_STEPS, LAST_HOLD_STEPS) == (500, 50, 10), FROZEN


@pytest.mark.parametrize(("name", "expected"), (BODIES | CONTACTS).items())
def test_what_the_scene_is_built_into_and_its_digest_does_not_see(name, expected):
    model = SCENE.compile()
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    values = getattr(model, name)
    assert weighted(values[touching] if name in CONTACTS else values) == pytest.approx(expected, rel=1e-6), FROZEN


def test_how_it_is_simulated():
    option = SCENE.compile().opt
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST, FROZEN
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC, FROZEN
    assert (option.timestep, option.gravity.tolist()) == (0.002, [0.0, 0.0, -9.81]), FROZEN
    assert TrapperSimulation.LEASH == 0.06, FROZEN


def test_the_law_by_which_episodes_start():
    place, velocity = draw_starts(SCENE, torch.arange(3), velocity=3.0, split="test", seed=0)
    torch.testing.assert_close(place.tolist(), PLACES, rtol=0, atol=1e-12, msg=FROZEN)
    torch.testing.assert_close(velocity.tolist(), VELOCITIES, rtol=0, atol=1e-12, msg=FROZEN)


def test_an_episode_starts_alike_whatever_is_drawn_beside_it_and_in_proportion_to_the_velocity():
    place, velocity = draw_starts(SCENE, torch.tensor([2, 0]), velocity=1.5, split="test", seed=0)
    torch.testing.assert_close(place.tolist(), [PLACES[2], PLACES[0]], rtol=0, atol=1e-12)
    torch.testing.assert_close((2 * velocity).tolist(), [VELOCITIES[2], VELOCITIES[0]], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("table_side", 0, "table_side must be >= 1e-09, got 0"),
        ("ball_mass", -6, "ball_mass must be >= 1e-09, got -6"),
        ("ball_mass", True, "ball_mass must be a finite number, got True"),
        ("base_height", math.nan, "base_height must be a finite number, got nan"),
        ("rolling_resistance", math.nan, "rolling_resistance must be a finite number, got nan"),
        ("rolling_resistance", -1e-4, "rolling_resistance must be >= 0, got -0.0001"),
        ("home", (0.0,) * 5 + (math.nan,), "home must be a finite number, got nan"),
        ("home", (0.0,) * 5, "home must be a tuple of 6 numbers"),
        ("home", [0.0] * 6, "home must be a tuple of 6 numbers"),
        ("servo_stiffness", (8000.0,) * 5 + (0,), "servo_stiffness must be >= 1e-09, got 0"),
        ("servo_damping", (400.0,) * 5 + (math.inf,), "servo_damping must be a finite number, got inf"),
        ("servo_damping", 400.0, "servo_damping must be a tuple of 6 numbers, got 400.0"),
    ],
)
def test_another_scene_that_cannot_be_is_refused(name, value, message):
    with pytest.raises(InputError, match=message):
        TrapperScene(**{name: value})


def test_another_scene_may_have_whole_numbers_a_sunk_base_and_no_rolling_resistance():
    other = TrapperScene(table_side=2, base_height=-0.1, rolling_resistance=0)
    assert other.half_side == 1.0
    assert other.digest() != SCENE.digest()
