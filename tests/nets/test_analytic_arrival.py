"""Arrivals by the limits of the joints: of a known arm, in place of a network."""

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import UR5_SPEED_LIMIT, Arm
from torchdyn_plan.nets import AnalyticArrival, SolvedJoints
from torchdyn_plan.planners import DynamicPlanner, IKPlanner

LIMITS = {"speed": [UR5_SPEED_LIMIT] * 6, "acceleration": [75.0] * 6}
DOWN = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))


@pytest.fixture(scope="module")
def arm():
    return Arm.ur5()


@pytest.fixture(scope="module", params=["path", "solved", "turned"])
def eta(request, arm):
    if request.param == "path":
        return AnalyticArrival(IKPlanner(arm), **LIMITS)
    rotation = DOWN if request.param == "turned" else None
    return AnalyticArrival(SolvedJoints(arm=arm, rotation=rotation), **LIMITS)


def states(count, seed=0, moving=0.0):
    """Robot states (count, 1, 15) about a bent pose."""
    draw = torch.Generator().manual_seed(seed)
    q = torch.tensor([-1.7, -1.1, 1.8, -2.2, -1.57, 0.0]) + 0.2 * torch.randn(count, 6, generator=draw)
    return torch.cat([q, moving * torch.randn(count, 6, generator=draw), torch.zeros(count, 3)], dim=-1).unsqueeze(1)


GOALS = torch.tensor([[0.1, 0.5, 0.1], [-0.2, 0.6, 0.2], [0.3, 0.4, 0.15]])


def test_it_tells_the_time_of_the_joints_that_it_found(eta):
    state = states(4, moving=0.3)
    arrival = eta.arrival(state, GOALS.expand(4, 3, 3))
    assert arrival.steps.shape == arrival.never.shape == (4, 3)
    assert not arrival.never.any()
    q, reached = eta.joints.goal_joints(state[..., :6], GOALS.expand(4, 3, 3))
    assert reached.all()
    tool = eta.joints.arm(q.reshape(-1, 6))[:, :3, 3].view(4, 3, 3)
    assert (tool - GOALS).norm(dim=-1).max() < 0.015
    torch.testing.assert_close(arrival.steps, eta.steps(q - state[..., :6], state[..., 6:12]))
    assert (arrival.steps > 10.0).all()
    assert (arrival.steps < 400.0).all()


def test_what_is_out_of_reach_is_never_reached(eta):
    goals = torch.cat([GOALS, torch.tensor([[3.0, 0.0, 0.0]])]).expand(2, 4, 3)
    assert eta.arrival(states(2), goals).never.tolist() == [[False, False, False, True]] * 2


def test_slowness_lag_and_settling_are_added(arm):
    planner, state, goals = IKPlanner(arm), states(2), GOALS.expand(2, 3, 3)
    plain = AnalyticArrival(planner, **LIMITS).arrival(state, goals).steps
    slow = AnalyticArrival(planner, slowdown=1.5, extra_steps=4.0, **LIMITS).arrival(state, goals).steps
    torch.testing.assert_close(slow, 1.5 * plain + 4.0)
    early = AnalyticArrival(planner, extra_steps=-1e4, **LIMITS).arrival(state, goals).steps
    assert (early == 0.0).all()
    coarse = AnalyticArrival(planner, control_step=0.008, **LIMITS).arrival(state, goals).steps
    torch.testing.assert_close(2.0 * coarse, plain)


def test_it_is_differentiable_by_the_path(arm):
    eta, goals = AnalyticArrival(IKPlanner(arm), **LIMITS), GOALS.expand(2, 3, 3).clone().requires_grad_()
    eta.arrival(states(2), goals).steps.sum().backward()
    assert goals.grad.isfinite().all()
    assert goals.grad.abs().sum() > 0.0
    small = torch.zeros_like(goals)
    small[0, 0, 0] = 1e-3
    with torch.no_grad():
        up, down = (eta.arrival(states(2), goals + sign * small).steps[0, 0] for sign in (1, -1))
    assert abs((up - down) / 2e-3 - goals.grad[0, 0, 0]) < 0.05 * goals.grad[0, 0, 0].abs() + 1.0


def test_a_planner_with_it_is_saved(arm, tmp_path):
    from torchdyn_plan.nets import ConstantVelocity

    planner = DynamicPlanner(IKPlanner(arm), ConstantVelocity(), AnalyticArrival(IKPlanner(arm), **LIMITS))
    planner.save_pretrained(tmp_path)
    again = DynamicPlanner.from_pretrained(tmp_path)
    torch.testing.assert_close(
        again.eta.arrival(states(2), GOALS.expand(2, 3, 3)).steps,
        planner.eta.arrival(states(2), GOALS.expand(2, 3, 3)).steps,
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"speed": [1.0] * 5}, "speed and acceleration must have equally many joints, got 5 and 6"),
        ({"speed": [0.0] * 6}, "speed must be a positive number for each joint"),
        ({"acceleration": [float("inf")] * 6}, "acceleration must be a positive number for each joint"),
        ({"joints": print}, "joints must have goal_joints, like an IKPlanner, got builtin_function_or_method"),
        ({"slowdown": 0.0}, "slowdown must be >= 0.001, got 0.0"),
    ],
)
def test_nonsense_is_named(arm, change, message):
    with pytest.raises(InputError, match=message):
        AnalyticArrival(**({"joints": IKPlanner(arm)} | LIMITS | change))


def test_shapes_are_checked(eta):
    with pytest.raises(InputError, match="robot_state must begin with 12 numbers of joints, got 3"):
        eta.arrival(torch.zeros(2, 1, 3), torch.zeros(2, 4, 3))
    with pytest.raises(InputError, match="goal must have shape"):
        eta.arrival(states(2), torch.zeros(2, 4, 2))
