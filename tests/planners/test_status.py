import pytest
import torch
from tensordict import TensorDict

from tests.planners.toy import (
    HISTORY,
    NO_MEMORY,
    SCHEDULE,
    Straight,
    StraightArrival,
    go_straight,
    make_planner,
    observation,
)
from tests.tasks.trapper.crossing import make_planner as make_waiting_planner
from tests.tasks.trapper.crossing import world
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import DynamicPlanner, LostBelow, Observation, PlanStatus
from torchdyn_plan.planners.judging import judge
from torchdyn_plan.planners.plan import FARTHEST, input_status, usable_path

pytestmark = pytest.mark.filterwarnings(NO_MEMORY)

NAN, INF = float("nan"), float("inf")
POCKETED = LostBelow(seen_below=-0.042, forecast_below=0.0)


def calm(*batch):
    """Targets that go straight, slowly."""
    td = observation(batch)
    td["target_history"] = td["target_pos"].unsqueeze(-2) + 0.002 * torch.arange(1.0 - HISTORY, 1.0)[:, None]
    return td


class Mocked(Straight):
    """Forecaster that returns ``garbage``, while there is any, in the rows whose target is at y < 0."""

    garbage = None

    def path(self, history):
        path = super().path(history)
        if self.garbage is not None:
            path[(history[:, -1, 1] < 0).nonzero().squeeze(-1), 7, 1] = self.garbage
        return path


def spoil_history(td, value, row=1):
    td["target_history"] = td["target_history"].clone()
    td["target_history"][row, 2, 0] = value


def spoil_target(td, value, row=1):
    td["target_pos"] = td["target_pos"].clone()
    td["target_pos"][row, 0] = value


def sink(td, _=None, row=1):
    td["target_pos"] = td["target_pos"].clone()
    td["target_pos"][row, 2] = -0.1


FAULTS = [
    pytest.param(spoil_history, NAN, PlanStatus.BAD_INPUT, id="history nan"),
    pytest.param(spoil_history, INF, PlanStatus.BAD_INPUT, id="history inf"),
    pytest.param(spoil_target, NAN, PlanStatus.BAD_INPUT, id="target nan"),
    pytest.param(sink, None, PlanStatus.TARGET_LOST, id="target lost"),
]


def follow(planner, faulty, spoil, value, steps=30):
    """What the planner wrote at each step for three rows, the middle one spoiled in the steps ``faulty``."""
    td, found = calm(3), []
    for step in range(steps):
        td["step_count"] = torch.full((3,), step)
        td["tool_pos"] = td["robot_state"] = td["tool_pos"] + 0.01 * td.get("action", torch.zeros(3, 3))
        shown = td.clone()
        if step in faulty:
            spoil(shown, value)
        found.append(planner(shown).clone())
        td["action"], td["plan"] = shown["action"], shown["plan"]
    return found


@pytest.mark.parametrize(("spoil", "value", "status"), FAULTS)
def test_a_row_that_cannot_plan_holds_says_so_and_recovers_and_the_others_do_not_notice(spoil, value, status):
    found = follow(make_planner(lost=POCKETED), range(2, 9), spoil, value)
    usual = follow(make_planner(lost=POCKETED), (), spoil, value)
    codes = torch.stack([td["plan", "status"] for td in found]).T.tolist()
    waiting, well = [PlanStatus.WAITING], [PlanStatus.OK]
    assert codes[0] == codes[2] == waiting * 3 + well * 27
    assert codes[1] == waiting * 2 + [status] * 7 + well * 21
    for td, other in zip(found, usual, strict=True):
        for key in ("goal", "action", "arrival_steps"):
            assert torch.equal(td[key][[0, 2]], other[key][[0, 2]])
            assert torch.isfinite(td[key]).all()
    for td in found[3:9]:
        assert torch.equal(td["goal"][1], td["tool_pos"][1])
        assert not td["action"][1].any()
        assert td["plan", "replanned"].tolist()[1] is False
        assert td["plan", "replans"][1] == 0
    assert found[9]["plan", "replanned"].tolist() == [False, True, False]
    assert found[9]["plan", "window"][1] == found[3]["plan", "window"][0]
    assert (found[9]["goal"][1] - found[9]["tool_pos"][1]).norm() > 0.01


@pytest.mark.parametrize(("spoil", "value", "status"), FAULTS)
def test_between_plans_a_fault_is_told_and_the_plan_is_kept(spoil, value, status):
    found, usual = (follow(make_planner(lost=POCKETED), faulty, spoil, value, 12) for faulty in (range(5, 8), ()))
    assert [int(td["plan", "status"][1]) for td in found] == [1] * 3 + [0] * 2 + [status] * 3 + [0] * 4
    assert all(torch.equal(td["goal"], other["goal"]) for td, other in zip(found, usual, strict=True))


def test_a_fault_from_the_start_to_the_end_leaves_the_arm_at_rest():
    found = follow(make_planner(lost=POCKETED), range(30), spoil_history, NAN)
    assert all(td["plan", "status"][1] == PlanStatus.BAD_INPUT for td in found)
    assert all(torch.equal(td["tool_pos"][1], found[0]["tool_pos"][1]) for td in found)


@pytest.mark.parametrize("garbage", [NAN, INF, 1e30, -2 * FARTHEST])
def test_garbage_from_the_forecaster_holds_its_rows_until_it_ends(garbage):
    forecaster = Mocked()
    planner = DynamicPlanner.paper(go_straight(), forecaster, StraightArrival(), schedule=SCHEDULE)
    td = calm(4)
    td["target_history"][:2, :, 1] -= 2.0
    td["target_pos"] = td["target_history"][:, -1]
    forecaster.garbage = garbage
    for step in range(3, 7):
        td["step_count"].fill_(step)
        planner(td)
        assert td["plan", "status"].tolist() == [PlanStatus.BAD_FORECAST] * 2 + [PlanStatus.OK] * 2
        assert torch.equal(td["goal"][:2], td["tool_pos"][:2])
        assert td["plan", "replanned"].tolist() == [False] * 2 + [step == 3] * 2
        assert torch.isfinite(td["action"]).all()
    forecaster.garbage = None
    td["step_count"].fill_(7)
    planner(td)
    assert td["plan", "status"].tolist() == [PlanStatus.OK] * 4
    assert td["plan", "replans"].tolist() == [1] * 4


def test_a_target_out_of_reach_for_ever_is_unreachable_until_it_is_not():
    planner, td = make_planner(), calm(2)
    near = td["target_history"].clone()
    td["target_history"] = near + torch.tensor([[[100.0]], [[0.0]]])
    td["target_pos"] = td["target_history"][:, -1]
    for step in range(15):
        td["step_count"].fill_(step)
        planner(td)
        assert torch.isfinite(td["action"]).all()
        expected = [PlanStatus.WAITING] * 2 if step < 3 else [PlanStatus.UNREACHABLE, PlanStatus.OK]
        assert td["plan", "status"].tolist() == expected
    td["target_history"], td["target_pos"] = near, near[:, -1]
    for step in range(15, 30):
        td["step_count"].fill_(step)
        planner(td)
    assert td["plan", "status"].tolist() == [PlanStatus.OK] * 2


class Spoiled:
    """A planner that is shown spoiled observations while ``spoil`` is set."""

    spoil = None

    def __init__(self, planner):
        self.planner = planner

    def __call__(self, td):
        if self.spoil is not None:
            td = td.clone()
            self.spoil[0](td, self.spoil[1])
        return self.planner(td)


@pytest.mark.parametrize(("spoil", "value", "status"), FAULTS)
@pytest.mark.parametrize("begin", [0, 10, 40])
def test_one_that_waits_and_drops_holds_and_recovers_too(spoil, value, status, begin):
    planner, scene, usual = Spoiled(make_waiting_planner()), world(3), world(3).run(make_waiting_planner(), begin + 45)

    def run(steps):
        # The planner writes into the copy that it was shown.
        found = []
        for _ in range(steps):
            found += scene.run(Through(planner), 1, plan=memory[0])
            memory[0] = found[-1]["plan"]
        return found

    memory = [None]
    before = run(begin)
    planner.spoil = spoil, value
    during = run(25)
    planner.spoil = None
    after = run(20)
    for td, other in zip([*before, *during, *after], usual, strict=True):
        assert torch.equal(td["goal"][[0, 2]], other["goal"][[0, 2]])
        assert torch.isfinite(td["goal"]).all()
        assert torch.isfinite(td["action"]).all()
    assert all(td["plan", "status"][1] == status for td in during)
    for td in during[15:]:
        assert torch.equal(td["goal"][1], td["tool_pos"][1])
        assert td["plan", "drop_step"][1] == -1
    assert after[-1]["plan", "status"].tolist() == [PlanStatus.OK] * 3
    assert (after[-1]["goal"][1] - during[-1]["goal"][1]).norm() > 0.01


class Through:
    """Hands what a planner wrote on to the tensordict that it was asked with."""

    def __init__(self, planner):
        self.planner = planner

    def __call__(self, td):
        written = self.planner(td)
        return td.update(written.select("goal", "action", "arrival_steps", "plan"))


def looking(target_pos, *seen):
    """Observation of targets at ``target_pos`` (*B, 3)."""
    step_count = torch.ones(target_pos.shape[:-1], dtype=torch.int64)
    return Observation(torch.zeros_like(target_pos), target_pos, target_pos, step_count, seen)


def status_of(observation, lost):
    return input_status(observation, judge(observation, TensorDict({}), [], [])[1].bad_input, lost)


def test_input_is_judged_for_any_batch():
    target = torch.zeros(2, 3, 3)
    target[0, 1, 1], target[1, 2, 2], target[1, 0, 2] = NAN, -0.5, -0.2
    seen = torch.zeros(2, 3, 6, 3), torch.zeros(2, 3, dtype=torch.int64)
    seen[0][1, 1, 5, 2] = -INF
    lost = LostBelow(seen_below=-0.3, forecast_below=0.0)
    codes = status_of(looking(target, *seen), lost)
    assert codes.tolist() == [[0, PlanStatus.BAD_INPUT, 0], [0, PlanStatus.BAD_INPUT, PlanStatus.TARGET_LOST]]
    assert status_of(looking(target[0, 1], *(value[0, 1] for value in seen)), lost) == PlanStatus.BAD_INPUT
    assert status_of(looking(target, *seen), None).tolist() == [[0, PlanStatus.BAD_INPUT, 0]] * 2


def test_opposite_infinities_are_no_number():
    history = torch.zeros(1, 4, 3)
    history[0, :2, 0] = torch.tensor([INF, -INF])
    assert status_of(looking(torch.zeros(1, 3), history), None).tolist() == [PlanStatus.BAD_INPUT]


def test_a_forecast_of_no_use_is_a_target_at_rest():
    forecast = torch.randn(3, 5, 3, generator=torch.Generator().manual_seed(0))
    forecast[1, 4, 2] = NAN
    target = torch.tensor([[1.0, 2.0, 3.0]]).expand(3, 3)
    known, usable = usable_path(forecast, target)
    assert usable.tolist() == [True, False, True]
    assert torch.equal(known[[0, 2]], forecast[[0, 2]])
    assert torch.equal(known[1], target[:1].expand(5, 3))


def test_where_nothing_can_be_lost_no_target_is():
    td = observation((2,), step=3)
    sink(td)
    assert (make_planner()(td)["plan", "status"] != PlanStatus.TARGET_LOST).all()


@pytest.mark.parametrize("name", ["seen_below", "forecast_below"])
@pytest.mark.parametrize("height", [NAN, -INF])
def test_a_bad_height_is_refused(name, height):
    with pytest.raises(InputError, match=f"{name} must be a finite number, got {height}"):
        LostBelow(**{"seen_below": 0.0, "forecast_below": 0.0, name: height})
