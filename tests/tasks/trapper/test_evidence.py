import pytest
import torch

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.evaluation.traces import Trace
from torchdyn_plan.tasks.trapper.evidence import GONE, NEVER, NOTICE, Evidence, find_evidence

SCENE = TrapperScene()
STEPS, SPEED = 201, 0.005
PLACE, MET = (0.2, 0.0, SCENE.ball_radius), 100
"""A ball rolls along x and is at `PLACE` at step `MET`."""


def rolling(steps=400):
    path = torch.zeros(1, steps, 3)
    path[..., 0] = PLACE[0] + SPEED * (torch.arange(steps) - MET)
    path[..., 2] = SCENE.ball_radius
    return path


def turned(at, speed):
    """The same ball, with another speed along x from step ``at`` on."""
    path = rolling()
    path[:, at:, 0] += (speed - SPEED) * torch.arange(path.shape[1] - at)
    return path


def record(*, plans=((20, PLACE, MET, True),), tool=((0.0, 0.5, 0.3),) * STEPS, length=STEPS - 1, path=None):
    """One episode, whose plans are made at a step, with a goal, for a step, and reachable or not."""
    goal, arrival = torch.zeros(1, STEPS, 3), torch.zeros(1, STEPS, dtype=torch.int64)
    planned, reachable = torch.zeros(2, 1, STEPS, dtype=torch.bool)
    for made, place, due, possible in plans:
        goal[:, made:], reachable[:, made:] = torch.tensor(place), possible
        arrival[:, made:] = (due - torch.arange(made, STEPS)).clamp_min(0)
        planned[:, made] = True
    path = rolling() if path is None else path
    still = torch.zeros(1, STEPS)
    return Trace(
        torch.tensor([tool]), path[:, :STEPS], goal, arrival, planned, reachable, torch.tensor([length]), still
    )


def tool_at(place, since):
    """High up until step ``since``, then at ``place``."""
    return ((0.0, 0.5, 0.3),) * since + (place,) * (STEPS - since)


def evidence(**changes):
    return Evidence(*(clue.item() for clue in find_evidence(SCENE, record(**changes), rolling())))


def test_a_promise_that_comes_true_has_no_errors():
    found = evidence(tool=tool_at((0.2, 0.0, 0.006), 97), length=100)
    assert found.planned
    assert found.promised
    assert found.forecast_error == pytest.approx(0.0, abs=1e-6)
    assert found.eta_error == -3
    assert found.contact_step == -1


def test_without_plans_there_is_nothing_to_judge():
    assert evidence(plans=()) == (False, False, 0.0, 0, -1, False)
    assert evidence(plans=((20, PLACE, MET, False),)) == (True, False, 0.0, 0, -1, False)


def test_a_promise_below_the_table_is_none():
    assert not evidence(plans=((20, (0.2, 0.0, -0.05), MET, True),)).promised


@pytest.mark.parametrize(("offset", "due", "error"), [(0.1, MET, 0.1), (0.0, MET + 30, 0.125), (0.0, MET - 6, 0.0)])
def test_a_forecast_is_judged_by_how_near_the_ball_comes_about_the_promised_time(offset, due, error):
    found = evidence(plans=((20, (0.2, offset, 0.042), due, True),))
    assert found.forecast_error == pytest.approx(error, abs=1e-6)


def test_a_ball_that_is_swallowed_before_its_meeting_is_nowhere():
    path = rolling()
    path[:, 90:, 2] = -0.05
    trace = record(path=path, length=95)
    assert find_evidence(SCENE, trace, path).forecast_error.item() == GONE


def test_the_forecast_is_that_of_the_plan_that_could_be_acted_on():
    wrong, right = (20, (0.2, 0.3, 0.042), MET, True), (MET - 4, PLACE, MET, True)
    assert evidence(plans=(wrong, right)).forecast_error == pytest.approx(0.3)
    early = (MET - NOTICE, PLACE, MET, True)
    assert evidence(plans=(wrong, early)).forecast_error == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("since", "late"), [(90, -10), (100, 0), (112, 12), (STEPS, NEVER)])
def test_an_arm_is_as_late_as_it_comes_to_its_goal(since, late):
    above = (0.2, 0.0, 0.2)
    assert evidence(plans=((20, above, MET, True),), tool=tool_at(above, since)).eta_error == late


def test_an_arm_whose_time_has_not_come_is_not_late():
    beside = (PLACE[0] - 0.2, 0.0, 0.006)
    found = evidence(tool=tool_at(beside, 30), path=turned(38, 0.0))
    assert 30 < found.contact_step < MET
    assert found.eta_error == 0


def test_a_ball_that_runs_into_the_box_is_not_receding_and_one_that_is_hit_from_behind_is():
    ahead, behind = (0.0, 0.0, 0.006), (-0.3, 0.0, 0.006)
    ran_into = evidence(tool=tool_at(ahead, 10), path=turned(38, -0.001))
    assert ran_into.contact_step == pytest.approx(MET - (0.2 + 0.113) / SPEED, abs=1)
    assert not ran_into.receding
    struck = evidence(tool=tool_at(behind, 16), path=turned(17, 0.01))
    assert struck.contact_step == 16
    assert struck.receding


def test_a_ball_that_passes_under_the_rim_is_not_touched():
    low = evidence(tool=tool_at((0.0, 0.0, 0.083), 10))
    assert low.contact_step == -1
    assert evidence(tool=tool_at((0.0, 0.0, 0.083), 10), path=turned(60, 0.003)).contact_step > 50


def test_after_a_contact_the_truth_is_the_path_of_a_ball_that_nothing_touched():
    path = rolling()
    path[:, 50:, 1] = 0.4
    tool = tool_at((PLACE[0] + SPEED * (49 - MET) + 0.1, 0.0, 0.006), 49)
    trace = record(path=path, tool=tool)
    found = find_evidence(SCENE, trace, rolling())
    assert found.contact_step.item() == 49
    assert found.forecast_error.item() == pytest.approx(0.0, abs=1e-6)
    assert find_evidence(SCENE, trace, path).forecast_error.item() == pytest.approx(0.4)


def test_what_lies_beyond_the_end_does_not_count():
    whole = record(tool=tool_at(PLACE, 150), length=120)
    cut = [field.clone() for field in whole]
    for field in cut:
        if field.ndim > 1:
            field[:, 121:] = True if field.dtype == torch.bool else 7
    for one, other in zip(*(find_evidence(SCENE, trace, rolling()) for trace in (whole, Trace(*cut))), strict=True):
        assert torch.equal(one, other)


def test_a_batch_is_its_rows():
    traces = [record(), record(plans=()), record(tool=tool_at((0.0, 0.0, 0.006), 10)), record(length=60)]
    together = find_evidence(SCENE, Trace(*map(torch.cat, zip(*traces, strict=True))), rolling().expand(4, -1, -1))
    alone = [find_evidence(SCENE, trace, rolling()) for trace in traces]
    for clue, *rows in zip(together, *alone, strict=True):
        assert torch.equal(clue, torch.cat(rows))


def test_nothing_recorded_is_no_evidence():
    none = Evidence.none(3)
    assert all(clue.shape == (3,) for clue in none)
    none.planned[0] = True
    assert not none.promised.any()
    assert none.contact_step.tolist() == [-1] * 3
