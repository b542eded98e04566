"""The rival by pace and path: what it makes of the static plan, and that it meets what pursuit runs after."""

import pytest
import torch
from tensordict import TensorDict

from tests.planners.toy import HISTORY, SPEED, go_straight, observation
from torchdyn_plan import keys
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import CallablePlanner, KalmanTrack, PaceAndPath, TargetPursuit, TrackedPlanner

STEP = 0.01
OWN = {"speed": SPEED / STEP, "control_step": STEP}


def make(**settings):
    return PaceAndPath(go_straight(), **{**OWN, **settings})


def point(*values):
    return torch.tensor([values], dtype=torch.float64)


def test_a_target_at_rest_leaves_the_static_plan_as_it_is():
    td = observation((7,))
    td[keys.TARGET_HISTORY] = td[keys.TARGET_POS].unsqueeze(-2).expand(7, HISTORY, 3).clone()
    plain = go_straight()(td.clone().set(keys.GOAL, td[keys.TARGET_POS]))
    found = make()(td.clone())
    assert torch.equal(found[keys.GOAL], td[keys.TARGET_POS])
    torch.testing.assert_close(found[keys.ACTION], plain[keys.ACTION])


def test_what_comes_along_the_way_is_made_up_for_by_the_pace():
    # The way of 1 m takes 1 s at 1 m/s, in which the target comes 0.4 m nearer: 0.6 of the pace will do.
    found = make().correct(point(0, 0, 0), point(1, 0, 0), point(-0.4, 0, 0))
    torch.testing.assert_close(found.pace, torch.tensor([0.6], dtype=torch.float64))
    torch.testing.assert_close(found.time, torch.tensor([1.0], dtype=torch.float64))
    torch.testing.assert_close(found.goal, point(0.6, 0, 0))


def test_what_goes_across_shifts_the_path_and_leaves_the_pace():
    found = make().correct(point(0, 0, 0), point(0.5, 0, 0), point(0, 0.2, -0.1))
    torch.testing.assert_close(found.pace, torch.ones(1, dtype=torch.float64))
    torch.testing.assert_close(found.goal, point(0.5, 0.1, -0.05))


def test_where_no_pace_will_do_the_plan_takes_longer_but_not_for_ever():
    runs = make(longest=3.0).correct(point(0, 0, 0), point(1, 0, 0), point(0.5, 0, 0))
    torch.testing.assert_close(runs.goal, point(2.0, 0, 0))
    torch.testing.assert_close(runs.time, torch.tensor([2.0], dtype=torch.float64))
    away = make(longest=3.0).correct(point(0, 0, 0), point(1, 0, 0), point(2.0, 0, 0))
    torch.testing.assert_close(away.goal, point(7.0, 0, 0))
    faster = make(fastest=2.0).correct(point(0, 0, 0), point(1, 0, 0), point(0.5, 0, 0))
    torch.testing.assert_close(faster.pace, torch.tensor([1.5], dtype=torch.float64))
    torch.testing.assert_close(faster.time, torch.tensor([1.0], dtype=torch.float64))


def test_the_end_of_a_plan_that_gets_no_nearer_has_its_time_and_its_own_pace():
    settling = make(settle=0.5, longest=3.0)
    found = settling.correct(point(0, 0, 0), point(1, 0, 0), point(-0.4, 0, 0))
    # 1.5 s pass, and the tool is on its way for 1 s of them: 0.4 m are left to it.
    torch.testing.assert_close(found.pace, torch.tensor([0.4], dtype=torch.float64))
    torch.testing.assert_close(found.time, torch.tensor([1.5], dtype=torch.float64))
    near = settling.correct(point(0, 0, 0), point(0.1, 0, 0), point(-1, 0, 0))
    torch.testing.assert_close(near.pace, torch.ones(1, dtype=torch.float64))


def test_at_the_target_and_at_rest_there_are_numbers_and_derivatives():
    places = [torch.zeros(1, 3, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    found = make().correct(*places)
    (found.goal.sum() + found.pace.sum() + found.time.sum()).backward()
    assert all(bool(value.isfinite().all()) for value in found)
    assert all(bool(place.grad.isfinite().all()) for place in places)


def test_batches_of_any_shape_act_as_their_rows():
    td = observation((2, 3))
    whole = make()(td.clone())
    for index in ((0, 0), (1, 2)):
        alone = make()(td[index].clone())
        torch.testing.assert_close(whole[keys.ACTION][index], alone[keys.ACTION])
        torch.testing.assert_close(whole[keys.GOAL][index], alone[keys.GOAL])
    assert whole[keys.ARRIVAL_STEPS].dtype == torch.int64


def test_rows_that_are_no_numbers_get_action_0_and_leave_the_others_alone():
    td = observation((4,))
    good = make()(td.clone())[keys.ACTION]
    td[keys.TARGET_HISTORY][1, -1] = torch.nan
    acted = make()(td)[keys.ACTION]
    assert torch.equal(acted[1], torch.zeros(3))
    assert torch.equal(acted[[0, 2, 3]], good[[0, 2, 3]])


def glide():
    """A static planner that goes straight at the goal, one `SPEED` a step in any direction."""

    def action(robot_state, goal):
        way = goal - robot_state[..., -3:]
        return way / way.norm(dim=-1, keepdim=True).clamp_min(SPEED)

    return CallablePlanner(action)


def steps_until_met(planner):
    """Control steps until the tool is at a target that crosses its way, 0.8 times as fast as the tool."""
    tool, target, step = torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 0.8 * SPEED, 0.0]])
    history = target.unsqueeze(1).repeat(1, HISTORY, 1)
    plan = {}
    for steps in range(400):
        if (tool - history[:, -1]).norm() < SPEED:
            return steps
        entries = {"tool_pos": tool, "robot_state": tool, "target_pos": history[:, -1], "target_history": history}
        td = planner(TensorDict({**entries, **plan, "step_count": torch.full((1,), steps)}, batch_size=1))
        plan = {"plan": td["plan"]} if "plan" in td.keys() else {}  # noqa: SIM118
        tool = tool + SPEED * td[keys.ACTION]
        history = torch.cat([history[:, 1:], history[:, -1:] + step], dim=1)
    return steps


def test_it_meets_what_crosses_its_way_sooner_than_pursuit_also_behind_a_track():
    pursuit, planner = steps_until_met(TargetPursuit(glide())), PaceAndPath(glide(), **OWN)
    # Straight to the meeting takes 1 / (0.6 SPEED) steps, and running after the target 1 / (0.36 SPEED).
    assert 265 < pursuit < 278
    assert 160 < steps_until_met(planner) < 200
    track = KalmanTrack(noise=1e-4)
    assert steps_until_met(TrackedPlanner(planner, track, control_step=STEP, history=HISTORY)) < 210


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"speed": 0.0}, "speed must be"),
        ({"control_step": 0.0}, "control_step must be"),
        ({"settle": -1.0}, "settle must be"),
        ({"slowest": 2.0}, "fastest must be >= 2"),
        ({"longest": float("nan")}, "longest must be a finite number"),
    ],
)
def test_a_number_out_of_range_is_named(settings, says):
    with pytest.raises(InputError, match=says):
        make(**settings)


def test_a_history_of_one_position_tells_no_velocity():
    td = observation((2,))
    td[keys.TARGET_HISTORY] = td[keys.TARGET_HISTORY][:, :1]
    with pytest.raises(InputError, match="target_history must have two positions at least, got 1"):
        make()(td)
