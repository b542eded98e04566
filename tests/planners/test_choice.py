"""Which of several targets is met next: points that go straight, and a robot that does, too."""

import pytest
import torch
from tensordict import TensorDict

from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import (
    ChoosingPlanner,
    DynamicPlanner,
    MatchVelocity,
    PlanStatus,
    PointPlanner,
    ReplanSchedule,
    TargetPursuit,
)

STEP, SPEED = 0.1, 1.0
DRIVE = PointPlanner(speed=SPEED, acceleration=20.0, control_step=STEP)


def planner_of(**settings):
    inner = DynamicPlanner(DRIVE, schedule=ReplanSchedule.every(1), **settings.pop("parts", {}))
    return ChoosingPlanner(inner, **({"every": 3, "sooner": 3.0} | settings)).eval()


def observation(places, velocity, present=None, step=5, **more):
    """Rows whose K targets are at ``places`` (N, K, 2) and go with ``velocity`` (N, K, 2)."""
    ago = STEP * torch.arange(-3.0, 1.0).view(4, 1)
    history = places.unsqueeze(-2) + ago * velocity.unsqueeze(-2)
    rows, count = places.shape[:2]
    entries = {
        "tool_pos": torch.zeros(rows, 2),
        "robot_state": torch.zeros(rows, 4),
        "step_count": torch.full((rows, 1), step),
        "targets_pos": places,
        "targets_history": history,
        "targets_present": torch.ones(rows, count, dtype=torch.bool) if present is None else present,
    }
    return TensorDict(entries | more, batch_size=[rows])


def act(planner, state):
    with torch.no_grad():
        return planner(state)


# One is near and flees, one is farther and comes: met at 5 (never) and at 3 / 1.5 = 2 s.
PLACES = torch.tensor([[[1.0, 0.0], [0.0, 3.0], [-4.0, 0.0]]]).repeat(2, 1, 1)
VELOCITY = torch.tensor([[[2.0, 0.0], [0.0, -0.5], [0.0, 0.0]]]).repeat(2, 1, 1)


@pytest.mark.filterwarnings("ignore:the planner's memory is missing")
def test_the_target_that_is_met_soonest_is_chosen_not_the_nearest():
    found = act(planner_of(), observation(PLACES, VELOCITY))
    assert found["plan", "choice_target"].tolist() == [1, 1]
    assert "target_pos" not in found.keys()  # noqa: SIM118


@pytest.mark.filterwarnings("ignore:the planner's memory is missing")
def test_empty_slots_do_not_count_and_a_row_without_any_holds_still():
    present = torch.tensor([[True, False, True], [False, False, False]])
    places = PLACES.clone()
    places[:, 1] = torch.nan
    found = act(planner_of(), observation(places, VELOCITY, present))
    assert found["plan", "choice_target"].tolist() == [2, -1]
    assert found["plan", "status"][1] == PlanStatus.TARGET_LOST
    assert torch.equal(found["action"][1], torch.zeros(2))


@pytest.mark.filterwarnings("ignore:the planner's memory is missing")
def test_a_value_goes_before_the_time_but_not_for_a_target_out_of_reach():
    value = torch.tensor([[9.0, 1.0, 2.0], [9.0, 2.0, 2.0]])
    found = act(planner_of(), observation(PLACES, VELOCITY, targets_value=value))
    assert found["plan", "choice_target"].tolist() == [2, 1]


def test_models_are_asked_once_for_all_targets():
    planner, asked = planner_of(), []
    forecaster, eta = planner.planner.forecaster, planner.planner.eta
    predict, arrival = forecaster.predict, eta.arrival
    forecaster.predict = lambda *seen: asked.append(tuple(seen[0].shape[:-2])) or predict(*seen)
    eta.arrival = lambda state, goal, **how: asked.append(tuple(goal.shape[:-2])) or arrival(state, goal, **how)
    act(planner, observation(PLACES, VELOCITY, step=0))
    # At step 0 the planner itself does not plan yet.
    assert asked == [(2, 3), (2, 3)]


def drive(planner, steps, places, velocity, switch=None):
    """Which target is chosen at each step; from step ``switch`` on the third one is met at once."""
    state, chosen = None, []
    for step in range(steps):
        if switch is not None and step >= switch:
            places = places.clone()
            places[:, 2] = torch.tensor([0.05, 0.0])
        seen = observation(places, velocity, step=step)
        if state is not None:
            seen["plan"] = state
        found = act(planner, seen)
        state = found["plan"]
        chosen.append(found["plan", "choice_target"][0].item())
        places = places + STEP * velocity
    return chosen, state


def test_a_choice_is_kept_until_another_is_met_much_sooner_and_the_plan_starts_afresh():
    chosen, state = drive(planner_of(), 12, PLACES, VELOCITY, switch=6)
    assert chosen[:6] == [1] * 6 or chosen[1:6] == [1] * 5
    assert chosen[-1] == 2
    assert state["replans"][0] < 12
    assert drive(planner_of(sooner=100.0), 12, PLACES, VELOCITY, switch=6)[0][-1] == 1


def test_a_maneuver_in_its_midst_keeps_its_target():
    own = MatchVelocity(hover=0.2, descent_steps=30, axis=(1.0, 0.0))
    parts = {"maneuver": own, "search": own.search(coordinates=2)}
    state = own.State(torch.tensor([-1, 0, 40, 59, 60]), torch.zeros(5, 2), torch.zeros(5, 2))
    assert own.committed(state).tolist() == [False, True, True, True, False]
    assert own.finished(state).tolist() == [False, False, False, False, True]
    planner = planner_of(parts=parts)
    seen = observation(PLACES, VELOCITY, step=0)
    memory = act(planner, seen)["plan"]
    memory["match_step"], memory["choice_target"] = torch.tensor([5, 5]), torch.tensor([2, 0])
    memory["choice_age"] = torch.tensor([9, 9])
    found = act(planner, observation(PLACES, VELOCITY, step=1).set("plan", memory))
    assert found["plan", "choice_target"].tolist() == [2, 0]


def test_it_is_saved_with_its_planner(tmp_path):
    planner = planner_of()
    planner.save_pretrained(tmp_path)
    again = ChoosingPlanner.from_pretrained(tmp_path)
    assert (again.every, again.sooner) == (3, 3.0)
    one, other = (act(each, observation(PLACES, VELOCITY, step=0)) for each in (planner, again))
    assert torch.equal(one["action"], other["action"])


def test_what_cannot_choose_is_named():
    with pytest.raises(InputError, match="planner must be a DynamicPlanner, got TargetPursuit"):
        ChoosingPlanner(TargetPursuit(DRIVE))
    with pytest.raises(InputError, match="every must be"):
        planner_of(every=0)
    with pytest.raises(InputError, match="reads the key 'targets_history'"):
        act(planner_of(), observation(PLACES, VELOCITY, step=0).exclude("targets_history"))
    with pytest.raises(InputError, match="targets_pos must have shape"):
        act(planner_of(), observation(PLACES, VELOCITY, step=0).set("targets_pos", PLACES[:, :2]))


def test_a_batch_of_any_shape_is_a_loop_over_its_rows():
    noise = 0.3 * torch.randn(2, 3, 3, 2, generator=torch.Generator().manual_seed(0))
    places, velocity = PLACES[:1].unsqueeze(1) + noise, VELOCITY[:1].unsqueeze(1) - noise
    flat = observation(places.flatten(0, 1), velocity.flatten(0, 1), step=0)
    expected = act(planner_of(), flat.clone())
    found = act(planner_of(), flat.clone().view(2, 3).to_tensordict())
    assert torch.equal(found["plan", "choice_target"].flatten(), expected["plan", "choice_target"])
    assert torch.equal(found["action"].flatten(0, 1), expected["action"])
