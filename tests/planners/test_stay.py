"""A tool that keeps to its place once the target has come."""

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import GoAndStay, Observation, Plan

HERE = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])


def seen(size=3):
    zero = torch.zeros(2, dtype=torch.int64)
    return Observation(HERE[:, :size], HERE[:, :size], HERE, zero, ())


def plan(steps, goal, *, reachable=True):
    yes = torch.ones(2, dtype=torch.bool)
    steps = torch.tensor(steps)
    return Plan(goal, steps, ~yes, yes & reachable, yes, torch.zeros(2, 0, 3), torch.zeros_like(steps))


def goals(maneuver, plans, holds=(False, False)):
    state, found = maneuver.start(seen()), []
    for one in plans:
        goal, state = maneuver(one, seen(), torch.tensor(holds), state)
        found.append(goal)
    return torch.stack(found)


@pytest.mark.parametrize("size", [2, 3, 7])
def test_it_goes_where_plans_say_until_shortly_before_the_meeting(size):
    # Row 0 comes within three steps of its meeting with the second plan, row 1 with the fourth.
    first = torch.arange(2.0 * size).view(2, size)
    plans = [plan(steps, first + number) for number, steps in enumerate([[5, 9], [3, 7], [9, 5], [9, 3], [9, 9]])]
    found = goals(GoAndStay(before=3), plans)
    assert found.shape == (5, 2, size)
    torch.testing.assert_close(found[:, 0] - first[0], torch.tensor([0.0, 1, 1, 1, 1]).view(5, 1).expand(5, size))
    torch.testing.assert_close(found[:, 1] - first[1], torch.tensor([0.0, 1, 2, 3, 3]).view(5, 1).expand(5, size))


def test_it_is_free_again_after_its_time():
    plans = [plan([2, 9], HERE + number) for number in range(4)]
    found = goals(GoAndStay(before=2, steps=2), plans)[:, 0] - HERE[0]
    torch.testing.assert_close(found[:, 0], torch.tensor([0.0, 0.0, 2.0, 2.0]))


@pytest.mark.parametrize("why", [{"reachable": False}, {}], ids=["unreachable", "held"])
def test_what_is_no_meeting_does_not_keep_it(why):
    plans = [plan([1, 1], HERE + number, **why) for number in range(3)]
    found = goals(GoAndStay(), plans, holds=(not why, not why))
    torch.testing.assert_close(found[-1], HERE + 2)


def test_a_target_that_is_there_keeps_it_whatever_its_plan_was():
    near = torch.tensor([[0.05, 0.0, 0.0], [0.2, 0.0, 0.0]])
    maneuver, observed = GoAndStay(within=0.1), seen()._replace(target_pos=HERE + near)
    state, found = maneuver.start(observed), []
    for number in range(3):
        goal, state = maneuver(plan([9, 9], HERE + number, reachable=False), observed, torch.zeros(2).bool(), state)
        found.append(goal - HERE)
    torch.testing.assert_close(torch.stack(found)[:, :, 0], torch.tensor([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]]))


@pytest.mark.parametrize("settings", [{"before": -1}, {"within": -0.1}, {"steps": 0}, {"steps": 1.5}])
def test_settings_that_cannot_be_are_refused(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        GoAndStay(**settings)
