import pytest
import torch

from tests.planners.toy import NO_MEMORY, SPEED, make_planner, observation
from torchdyn_plan.planners import EventSchedule, Meeting

EVENTS = EventSchedule(first_step=3, every=2, minimum=4, maximum=20, miss=0.01, late=3.0)


def run(planner, steps, turn=None, stuck=False):
    """Steps at which row 0 plans; its target turns round at step ``turn``; a stuck tool does not come nearer."""
    td, due = observation((1,)), []
    velocity, target, tool = torch.tensor([0.006, 0.0, 0.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 0.1])
    history = torch.stack([target + (back - 5) * velocity for back in range(6)])
    for step in range(steps):
        td["step_count"] = torch.tensor([step])
        td["target_pos"], td["target_history"] = history[None, -1], history[None]
        td["tool_pos"] = td["robot_state"] = tool[None]
        planner(td)
        due += [step] if td["plan", "replanned"] else []
        sign = -1 if turn is not None and step >= turn else 1
        history = torch.cat([history[1:], history[-1:] + sign * velocity])
        if not stuck:
            tool = tool + SPEED * td["action"][0]
    return due


def meets_far(forecast, target_pos, eta, context):
    """Meets at a place and after a time that `EVENTS` finds nothing wrong with."""
    one = torch.ones(target_pos.shape[:-1], dtype=torch.bool)
    goal = torch.tensor([0.4, 0.0, 0.1]).expand_as(target_pos)
    return Meeting(goal, one * 41, ~one, one)


def test_a_plan_that_fits_is_kept_and_a_target_that_turns_is_seen_at_the_next_look():
    assert run(make_planner(schedule=EVENTS, search=meets_far), 30) == [3, 23]
    # The miss grows by 12 mm a step: it is past 10 mm one step after the turn.
    assert run(make_planner(schedule=EVENTS, search=meets_far), 20, turn=9) == [3, 11]


def test_a_robot_that_is_late_is_seen():
    """Planned with one step to spare, and a step later with each that it stays: three after four, five after six."""
    assert run(make_planner(schedule=EVENTS, search=meets_far), 18, stuck=True) == [3, 9, 15]


@pytest.mark.filterwarnings(NO_MEMORY)
def test_what_is_looked_at_is_kept_and_declared():
    planner, td = make_planner(schedule=EVENTS), observation((2,), step=3)
    planner(td)
    assert td["plan", "path"].shape == (2, EVENTS.maximum + 1, 3)
    assert {key for key in td.keys(True, True) if isinstance(key, tuple)} <= set(planner.out_keys)
