"""A plane is space at one height: whatever its parts, a planner does the same in both, and at every height."""

import pytest
import torch

from tests.envs.points import STRIDE, PointEnv
from torchdyn_plan.envs import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import (
    Ballistic,
    Billiard,
    ConstantVelocity,
    ETANetwork,
    Forecaster,
    SpreadForecaster,
    SpreadNetwork,
)
from torchdyn_plan.planners import (
    CornerSearch,
    Delayed,
    DynamicPlanner,
    EventSchedule,
    ExactSearch,
    KalmanTrack,
    LeastSquaresTrack,
    LostBelow,
    ProportionalController,
    RecordedFuture,
    ReplanSchedule,
    SoftCornerSearch,
    SoftExactSearch,
    TargetPursuit,
    TrackedPlanner,
    wait_at_end,
)

HISTORY, HORIZON = 6, 30
EVERY = ReplanSchedule.every(2, first_step=1)
PLACES = ("tool_pos", "target_pos", "target_history", "achieved_goal", "desired_goal", "robot_state", "observation")


def straight_steps(robot_state, goal):
    return (goal - robot_state).norm(dim=-1) / STRIDE


def planner(forecaster=None, eta=straight_steps, make=DynamicPlanner, **parts):
    forecaster = ConstantVelocity(horizon=HORIZON) if forecaster is None else forecaster
    return make(ProportionalController(gain=1.0 / STRIDE), forecaster, eta, **{"schedule": EVERY, **parts}).eval()


def network():
    torch.manual_seed(0)
    made = Forecaster(history=HISTORY, horizon=HORIZON, half_extent=2.0, square_symmetry=True)
    return made.requires_grad_(False)


def judged():
    forecaster = network()
    spread = SpreadNetwork(features=forecaster.config.hidden, horizon=HORIZON)
    return SpreadForecaster(forecaster, spread).requires_grad_(False)


def tracked(track):
    return lambda: TrackedPlanner(planner(), track, control_step=0.1, history=HISTORY)


FULL = ExactSearch(stride=2, half_extent=0.7, footprint=0.1, switching_cost=1.0, arrival_radius=0.05, base_pos=(0, 0))
PLANNERS = {
    "exact": lambda: planner(search=ExactSearch(stride=1, first=1)),
    "exact, all of it": lambda: planner(search=FULL),
    "exact, coarse": lambda: planner(search=ExactSearch(stride=1, first=1, coarse=4)),
    "exact, by probability": lambda: planner(search=ExactSearch(stride=1, probability_weight=5.0, footprint=0.1)),
    "corner": lambda: planner(search=CornerSearch()),
    "soft exact": lambda: planner(search=SoftExactSearch(search=FULL)),
    "soft corner": lambda: planner(search=SoftCornerSearch()),
    "on events": lambda: planner(schedule=EventSchedule(first_step=1, every=1, minimum=1)),
    "delayed": lambda: planner(delivery=Delayed(2)),
    "pursuit": lambda: TargetPursuit(ProportionalController(gain=1.0 / STRIDE)),
    "wait": lambda: planner(make=wait_at_end),
    "billiard": lambda: planner(Billiard(1.0, horizon=HORIZON, gaps=((0.2, 0.4),))),
    "function": lambda: planner(lambda history: history[..., -1:, :].expand(*history.shape[:-2], HORIZON, -1)),
    "network": lambda: planner(network()),
    "network with its spread": lambda: planner(judged(), search=FULL),
    "network for inference": lambda: planner(network()).for_inference(),
    "kalman": tracked(KalmanTrack(noise=0.01)),
    "kalman with acceleration": tracked(KalmanTrack(noise=0.01, accelerates=True)),
    "least squares": tracked(LeastSquaresTrack(noise=0.01)),
}


def seen(num_envs=4, **series):
    """A rollout of what is seen in a plane, by an arm that is pushed at random: ``(N, T)``."""
    torch.manual_seed(0)
    env = PointEnv(num_envs, coordinates=2, history=HISTORY, speed=0.03, control_step=0.1, **series)
    return env.rollout(8, break_when_any_done=False).exclude("next", "action")


def lifted(observed, height):
    """The same in space, at that height."""
    found = observed.clone()
    for key in (*PLACES, "measured_pos"):
        if key in found.keys():  # noqa: SIM118
            found[key] = torch.nn.functional.pad(found[key], (0, 1), value=height)
    return found


def played(planner, observed):
    """Goals, times and actions of a planner that is shown one step after the other: ``(N, T, …)`` each."""
    memory, found = None, []
    for step in range(observed.shape[1]):
        td = observed[:, step].clone()
        if memory is not None:
            td["plan"] = memory
        td = planner(td)
        memory = td.get("plan", None)
        found.append([td[key].clone() for key in ("goal", "arrival_steps", "action")])
    return [torch.stack(values, 1) for values in zip(*found, strict=True)]


HEIGHTS = [(name, 0.0) for name in PLANNERS] + [(name, -0.3) for name in PLANNERS if "network" not in name]
"""A network takes a plane for height 0; to all others a height is as good as any."""


@pytest.mark.parametrize(("name", "height"), HEIGHTS)
def test_a_plane_is_space_at_one_height(name, height):
    measured = {"sensor": Sensor(noise=0.01)} if "kalman" in name or "least" in name else {}
    observed = seen(**measured)
    goal, steps, action = played(PLANNERS[name](), observed)
    goal_above, steps_above, action_above = played(PLANNERS[name](), lifted(observed, height))
    assert goal.shape[-1] == 2
    # Heights that are all alike add rounding alone.
    torch.testing.assert_close(steps.float(), steps_above.float())
    torch.testing.assert_close(goal, goal_above[..., :2], atol=1e-5, rtol=0)
    torch.testing.assert_close(action, action_above[..., :2], atol=1e-4, rtol=0)
    torch.testing.assert_close(goal_above[..., 2], torch.full_like(goal[..., 0], height), atol=2e-3, rtol=0)


def test_a_planner_in_a_plane_meets_its_targets():
    env = PointEnv(16, coordinates=2, history=HISTORY, speed=0.02, max_steps=40)
    rollout = env.rollout(40, planner(search=ExactSearch(stride=1, first=1)), break_when_any_done=False)
    assert rollout["next", "met"].any(1).all()


def test_an_arrival_network_of_a_plane_serves_a_planner():
    torch.manual_seed(0)
    eta = ETANetwork(robot_state_size=2, tool_slice=(0, 2), bins=30, bin_width=1, hidden=32)
    goals = torch.randn(5, 7, 2)
    states = torch.randn(5, 1, 2)
    assert eta(states, goals).shape == (5, 7, 31)
    torch.testing.assert_close(eta.for_inference()(states, goals), eta(states, goals))
    goal, _, _ = played(planner(eta=eta.requires_grad_(False)), seen())
    assert goal.shape == (4, 8, 2)


def test_the_truth_may_lie_in_a_plane():
    observed = seen()
    future = observed["target_pos"].unsqueeze(-2).expand(-1, -1, 60, 2).clone()
    goal, _, _ = played(planner(RecordedFuture(HORIZON)), observed.set("target_future", future))
    assert goal.shape[-1] == 2


def test_a_memory_of_a_plane_is_carried_by_a_primer():
    made = planner()
    env = PointEnv(3, coordinates=2, history=HISTORY).append_transform(made.make_tensordict_primer(coordinates=2))
    assert env.rollout(5, made)["plan", "goal"].shape == (3, 5, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tool_pos": 4}, r"tool_pos must have shape \(\*B, 2\) or \(\*B, 3\), got \(4, 4\)"),
        ({"tool_pos": 3}, "tool_pos and target_pos must have equally many coordinates, got 3 and 2"),
        ({"target_pos": 3}, "tool_pos and target_pos must have equally many coordinates, got 2 and 3"),
        ({"target_history": 3}, "target_history must have shape"),
    ],
)
def test_points_of_other_sizes_are_named(change, message):
    td = seen()[:, 3]
    for key, size in change.items():
        td[key] = torch.zeros(*td[key].shape[:-1], size)
    with pytest.raises(InputError, match=message):
        planner()(td)


def test_what_needs_a_height_says_so():
    with pytest.raises(InputError, match="LostBelow needs points of 3 coordinates, got 2"):
        planner(lost=LostBelow(seen_below=0.0, forecast_below=0.0))(seen()[:, 0])
    with pytest.raises(InputError, match="gravity has 3 numbers, but targets 2 coordinates"):
        planner(Ballistic(horizon=5))(seen()[:, 3])
    assert Ballistic(horizon=5, gravity=(0.0, -9.81)).predict(torch.zeros(3, HISTORY, 2)).path.shape == (3, 5, 2)
