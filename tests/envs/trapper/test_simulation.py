import math

import pytest
import torch

from torchdyn_plan.envs import TrapperScene, TrapperSimulation
from torchdyn_plan.envs.trapper.scene import GRAVITY
from torchdyn_plan.kinematics import UR5_LINKS, UR5_SPEED_LIMIT

SCENE = TrapperScene()
RADIUS, MASS, STEP = SCENE.ball_radius, SCENE.ball_mass, SCENE.control_step
LINE = SCENE.half_side - RADIUS
"""Where a ball's centre is when it touches a cushion."""


def balls(place, velocity, friction=0.0):
    place, velocity = (torch.as_tensor(value, dtype=torch.float64) for value in (place, velocity))
    simulation = TrapperSimulation(len(place), SCENE, friction=friction, num_threads=1, arm=False)
    simulation.reset(torch.arange(len(place)), place, velocity)
    return simulation


def arms(count):
    simulation = TrapperSimulation(count, SCENE, num_threads=1)
    far = torch.tensor([0.0, SCENE.half_side - 2 * RADIUS], dtype=torch.float64).expand(count, 2)
    simulation.reset(torch.arange(count), far, torch.zeros(count, 2, dtype=torch.float64))
    return simulation


def energy(simulation):
    """Kinetic energy, rotation included, and height above the cloth, (N,) [J]."""
    moving = 0.5 * MASS * simulation.ball_vel.square().sum(-1)
    turning = 0.5 * (0.4 * MASS * RADIUS**2) * simulation.ball_spin.square().sum(-1)
    return moving + turning + MASS * GRAVITY * (simulation.ball_pos[:, 2] - RADIUS)


def slip(simulation):
    """Velocity of the ball's lowest point, (N, 2) [m/s]."""
    x, y = simulation.ball_spin[:, :2].unbind(-1)
    return simulation.ball_vel[:, :2] - RADIUS * torch.stack([y, -x], dim=-1)


@pytest.mark.parametrize("speed", [1.0, 5.0])
def test_a_ball_never_has_more_energy_than_it_started_with(speed):
    random = torch.Generator().manual_seed(0)
    place = torch.rand(256, 2, generator=random, dtype=torch.float64) * 2 - 1
    angle = 2 * math.pi * torch.rand(256, generator=random, dtype=torch.float64)
    simulation = balls(place * (LINE - 0.005), speed * torch.stack([angle.cos(), angle.sin()], dim=-1))
    start = energy(simulation)
    least = start.clone()
    for _ in range(300):
        simulation.step()
        now = energy(simulation)
        # While a cushion or a pocket's edge is pressed in, it holds energy and gives it back: at most what was there.
        assert (now <= start * (1 + 1e-6)).all()
        free = simulation.ball_pos[:, :2].abs().amax(-1) < LINE - 0.003
        # The cloth is a spring too, in which a ball that lands from a cushion bounces: a thousandth of the start.
        assert (now <= least + 1e-3 * start)[free].all()
        least = torch.where(free, torch.minimum(least, now), least)
    assert (now < start).all()


def test_a_ball_slows_by_the_cloths_resistance_to_rolling_alone():
    simulation = balls([[-0.5, 0.05], [0.05, -0.5]], [[0.5, 0.0], [0.0, 0.8]])
    speeds = []
    for _ in range(180):
        simulation.step()
        speeds.append(simulation.ball_vel[:, :2].norm(dim=-1))
    slowing = (speeds[20] - speeds[-1]) / (159 * STEP)
    expected = 5 / 7 * GRAVITY * SCENE.rolling_resistance / RADIUS
    torch.testing.assert_close(slowing, torch.full_like(slowing, expected), rtol=0.05, atol=0)


def test_a_ball_rolls_without_slipping_in_any_direction():
    angle = torch.arange(12, dtype=torch.float64) * math.pi / 6
    direction = torch.stack([angle.cos(), angle.sin()], dim=-1)
    simulation = balls(torch.zeros(12, 2), 2.0 * direction)
    for _ in range(60):
        simulation.step()
        assert slip(simulation).norm(dim=-1).max() < 0.01 * 2.0
    assert (simulation.ball_pos[:, :2].norm(dim=-1) > 0.4).all()


def test_a_sliding_ball_comes_to_roll_at_five_sevenths_of_its_speed():
    simulation = balls([[-0.5, 0.0]], [[1.0, 0.0]])
    simulation.ball_spin.zero_()
    for _ in range(round(2 / 7 / (SCENE.cloth_friction * GRAVITY) / STEP) + 25):
        simulation.step()
    assert slip(simulation).norm() < 0.01
    assert float(simulation.ball_vel[0, 0]) == pytest.approx(5 / 7, rel=0.05)


@pytest.mark.parametrize("friction", [2.5, 9.5])
def test_friction_loss_slows_a_rolling_ball(friction):
    simulation = balls([[-0.6, 0.05]], [[3.0, 0.0]], friction)
    speeds = []
    for _ in range(60):
        simulation.step()
        speeds.append(float(simulation.ball_vel[0, 0]))
    assert (speeds[10] - speeds[-1]) / (49 * STEP) == pytest.approx(friction / (1.4 * MASS), rel=0.15)


def first_contact(speed, angle):
    """Ball velocities (M, 2) just before and just after each ball's first contact with the cushion at +y."""
    speed, angle = (grid.reshape(-1) for grid in torch.meshgrid(speed, angle, indexing="ij"))
    velocity = speed[:, None] * torch.stack([angle.sin(), angle.cos()], dim=-1)
    simulation = balls(torch.tensor([[0.0, LINE - 0.05]]).expand(len(speed), 2), velocity)
    before, after = velocity.clone(), torch.full_like(velocity, torch.nan)
    touched = torch.zeros(len(speed), dtype=torch.bool)
    for _ in range(400):
        free = simulation.ball_pos[:, 1] < LINE
        now = simulation.ball_vel[:, :2]
        before[free & ~touched] = now[free & ~touched]
        left = free & touched & after[:, 0].isnan()
        after[left] = now[left]
        touched |= ~free
        simulation.batch.step(None, nstep=1)
    assert not after.isnan().any()
    return before, after


def returned_share(speed, step=1e-6):
    """Speed after a frontal hit over that before, of the cushion's own equation solved in microseconds."""
    share = []
    for start in speed.tolist():
        depth, rate = 0.0, start
        while depth >= 0.0:
            pressed = (0.1 + 0.89 * min(depth / SCENE.cushion_nose, 1.0)) / 0.99
            force = pressed * (SCENE.cushion_damping * rate + pressed * SCENE.cushion_stiffness * depth)
            rate -= step * max(force, 0.0)
            depth += step * rate
        share.append(-rate / start)
    return torch.tensor(share, dtype=torch.float64)


def test_a_cushion_returns_the_damped_springs_share_and_keeps_the_tangential_speed():
    speed = torch.tensor([0.5, 1.0, 2.0, 3.0, 4.0, 5.0], dtype=torch.float64)
    angle = torch.tensor([-0.9, 0.0, 0.5, 1.0], dtype=torch.float64)
    before, after = first_contact(speed, angle)
    share = -after[:, 1] / before[:, 1]
    expected = returned_share((speed[:, None] * angle.cos()).reshape(-1))
    torch.testing.assert_close(share, expected, rtol=0.05, atol=0)
    torch.testing.assert_close(after[:, 0], before[:, 0], rtol=0.05, atol=1e-3)


def random_actions(count, seed=1):
    return torch.rand(count, 16, 6, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def bang_bang(hold):
    return random_actions(200)[torch.arange(200) // hold].sign()


def drive(simulation, actions):
    """Joint speeds (T, N, 6) of arms, 0 from their first contact on, and the servos' torques (T, N, 6)."""
    contacts, force = simulation.batch.bind("ncon"), simulation.batch.bind("actuator_force")
    touched = torch.zeros(simulation.num_envs, 1, dtype=torch.bool)
    speeds, torques = [], []
    for action in actions:
        simulation.step(action)
        touched |= torch.tensor(contacts).reshape(-1, 1) > 1
        speeds.append(torch.where(touched, 0.0, simulation.joint_vel))
        torques.append(torch.tensor(force))
    return torch.stack(speeds), torch.stack(torques)


def test_random_actions_keep_every_joint_within_its_speed_limit():
    speeds, _ = drive(arms(16), random_actions(200))
    assert speeds.abs().max() <= 1.02 * UR5_SPEED_LIMIT
    assert speeds.abs().max() > 0.5 * UR5_SPEED_LIMIT


@pytest.mark.parametrize("hold", [1, 20, 50])
def test_full_speed_reversals_keep_torques_within_their_limits(hold):
    limit = torch.tensor([link.torque_limit for link in UR5_LINKS], dtype=torch.float64)
    _, torques = drive(arms(16), bang_bang(hold))
    assert (torques.abs() <= limit + 1e-9).all()
    assert (torques.abs().amax((0, 1)) > 0.5 * limit).all()


@pytest.mark.parametrize("hold", [1, 20, 50])
def test_a_servo_brakes_a_joint_that_the_others_carry_beyond_its_speed_limit(hold):
    simulation = arms(16)
    stiffness, damping = (torch.tensor(gain) for gain in (SCENE.servo_stiffness, SCENE.servo_damping))
    control, beyond = torch.from_numpy(simulation.batch.bind("ctrl")), 0
    for action in bang_bang(hold):
        simulation.step(action)
        force = stiffness * (control - simulation.joint_pos) - damping * simulation.joint_vel
        fast = simulation.joint_vel.abs() > UR5_SPEED_LIMIT
        assert (force * simulation.joint_vel <= 0)[fast].all()
        beyond += int(fast.sum())
    assert beyond > 0


def test_a_commanded_speed_is_followed():
    simulation, action = arms(2), torch.zeros(2, 6)
    action[0, 0], action[1, 4] = 0.3, -0.5
    speeds, _ = drive(simulation, action.expand(50, 2, 6))
    expected = action.double() * UR5_SPEED_LIMIT
    torch.testing.assert_close(speeds[-1], expected, atol=0.02 * UR5_SPEED_LIMIT, rtol=0)


def test_actions_beyond_the_limit_are_cut_to_it():
    one, other = arms(2), arms(2)
    wild = 5 * random_actions(20)[:, :2]
    for action in wild:
        one.step(action)
        other.step(action.clamp(-1, 1))
    assert torch.equal(one.joint_pos, other.joint_pos)


def test_a_reset_puts_its_rows_back_and_leaves_the_others_alone():
    simulation = arms(4)
    start = [value.clone() for value in (simulation.joint_pos, simulation.joint_vel)]
    for action in random_actions(30)[:, :4]:
        simulation.step(action)
    kept = simulation.joint_pos[[0, 3]].clone()
    place, velocity = torch.tensor([[0.1, 0.2], [0.3, -0.4]]), torch.tensor([[1.0, -2.0], [0.0, 0.5]])
    simulation.reset(torch.tensor([1, 2]), place.double(), velocity.double())
    assert torch.equal(simulation.joint_pos[[0, 3]], kept)
    for value, expected in zip((simulation.joint_pos, simulation.joint_vel), start, strict=True):
        assert torch.equal(value[[1, 2]], expected[[1, 2]])
    assert torch.equal(simulation.ball_pos[[1, 2], :2], place.double())
    assert slip(simulation)[[1, 2]].abs().max() < 1e-12
    quiet = arms(4)
    for _ in range(20):
        simulation.step(torch.zeros(4, 6))
        quiet.step(torch.zeros(4, 6))
    assert torch.equal(simulation.joint_pos[[1, 2]], quiet.joint_pos[[1, 2]])
