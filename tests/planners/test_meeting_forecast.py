import dataclasses

import torch

from tests.planners.test_meeting import DROP, SEARCH, TABLE, World, make_planner, world
from tests.planners.toy import HISTORY, StraightArrival, assert_same, go_straight
from torchdyn_plan.nets import Forecaster, SpreadNetwork
from torchdyn_plan.planners import Adaptation, MeetingPlanner
from torchdyn_plan.planners.adaptation import Course

DRAG = 1e-5


class Rough(World):
    """Targets that brake by `DRAG` along each axis."""

    def run(self, planner, steps, plan=None):
        found = []
        for _ in range(steps):
            found += super().run(planner, 1, plan)
            plan = found[-1]["plan"]
            self.velocity = self.velocity - DRAG * self.velocity.sign()
        return found


def rough(*batch):
    start = torch.tensor([-0.4, 0.3, TABLE]).expand(*batch, 3)
    velocity, tool = torch.tensor([0.006, -0.005, 0.0]), torch.tensor([0.2, 0.0, 0.12])
    return Rough(start, velocity.expand(*batch, 3), tool.expand(*batch, 3))


def test_it_learns_how_a_target_brakes_and_sees_where_it_will_be():
    missed = {}
    for adaptation in (None, Adaptation()):
        scene = rough()
        found = scene.run(make_planner(adaptation=adaptation, drop=dataclasses.replace(DROP, speed=0.0)), 60)
        td = found[53]
        assert bool(td["plan", "replanned"])
        ahead = torch.arange(38.0).unsqueeze(-1)
        speed = td["target_pos"] - found[52]["target_pos"]
        truth = td["target_pos"] + ahead * speed - 0.5 * DRAG * speed.sign() * ahead * (ahead + 1)
        missed[adaptation] = (td["plan", "outlook"][:38] - truth)[:, :2].abs().amax()
        if adaptation:
            assert (adaptation.drag(td["plan", "drags"]) / DRAG - 1).abs() < 0.3
    assert missed[adaptation] < 0.35 * missed[None]


def test_its_memory_is_under_plan_and_only_if_it_adapts():
    names = {("plan", name) for name in Course._fields}
    assert names.isdisjoint(make_planner().out_keys)
    planner = make_planner(adaptation=Adaptation())
    assert names <= set(planner.out_keys)
    td = world(2, 3).run(planner, 20)[-1]
    assert set(Course._fields) <= set(td["plan"].keys())
    assert td["plan", "drags"].shape == (2, 3, 8, 2)


def test_rows_that_start_afresh_have_learnt_nothing():
    planner, scene = make_planner(adaptation=Adaptation()), rough(2)
    plan = scene.run(planner, 60)[-1]["plan"]
    assert not plan["drags"].isnan().all(-1).all(-1).any()
    scene.step_count[1] = 0
    (td,) = scene.run(planner, 1, plan)
    assert bool(td["plan", "drags"][1].isnan().all())
    assert torch.equal(td["plan", "course"][1], td["target_pos"][1, :2].expand(16, 2))
    assert not td["plan", "drags"][0].isnan().all()


def test_a_forecast_that_comes_true_is_left_alone():
    plain, adapting = (world(7).run(make_planner(adaptation=way), 60) for way in (None, Adaptation()))
    for one, other in zip(plain, adapting, strict=True):
        torch.testing.assert_close(one["goal"], other["goal"])
        assert torch.equal(one["arrival_steps"], other["arrival_steps"])


def test_a_broken_forecast_teaches_nothing_and_stays_in_its_row():
    planner, scene = make_planner(adaptation=Adaptation()), world(4)
    plan = scene.run(planner, 25)[-1]["plan"]
    planner.forecaster.broken = torch.nan
    td = scene.run(planner, 20, plan)[-1]
    assert bool(td["goal"].isfinite().all())
    assert bool(td["plan", "course"].isfinite().all())


def networks():
    torch.manual_seed(0)
    forecaster = Forecaster(history=HISTORY, horizon=150, hidden=16, channels=8)
    return forecaster.eval(), SpreadNetwork(features=16, horizon=150, hidden=8, rank=4).eval()


def test_a_spread_is_read_by_a_cautious_search_only():
    forecaster, spread = networks()
    found = {}
    with torch.no_grad():
        spread.head.weight.normal_()
        for told, caution in ((None, 0.0), (spread, 0.0), (spread, 40.0)):
            search = dataclasses.replace(SEARCH, caution=caution)
            planner = MeetingPlanner(
                go_straight(), forecaster, StraightArrival(), search=search, drop=DROP, lead=3, spread=told
            )
            found[told is spread, caution] = world(16).run(planner, 14)[-1]
    assert_same(found[False, 0.0], found[True, 0.0])
    assert not torch.equal(found[True, 40.0]["goal"], found[True, 0.0]["goal"])
