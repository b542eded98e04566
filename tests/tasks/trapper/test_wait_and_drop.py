import dataclasses
import itertools

import pytest
import torch
from tensordict import TensorDict

from tests.planners.toy import assert_same
from tests.tasks.trapper.crossing import ABOVE, DROP, MANEUVER, SEARCH, TABLE, World, line, make_planner, world
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import Delayed, EventSchedule
from torchdyn_plan.tasks.trapper.wait_and_drop import DropState


def test_it_waits_above_the_meeting_place_and_drops_when_the_clearance_says():
    found = line().run(make_planner(), 140)
    down = [int(td["plan", "drop_step"]) >= 0 for td in found]
    start = down.index(True)
    assert start > 30
    for td in found[13:start]:
        assert td["goal"][2].item() == pytest.approx(ABOVE)
    for before, td in zip(found[start - 5 : start], found[start - 4 : start + 1], strict=True):
        ahead = torch.arange(DROP.lookahead)[:, None] * torch.tensor([0.004, 0.0, 0.0])
        clearance = DROP.clearance(td["target_pos"] + ahead, td["tool_pos"], td["tool_pos"] - before["tool_pos"])
        assert (int(clearance.argmax()) == 0 and float(clearance[0]) > 0) == (td is found[start])
    landed = found[start + 12]
    assert all(down[start : start + 30])
    assert landed["goal"][2].item() == pytest.approx(TABLE)
    assert landed["tool_pos"][2].item() == pytest.approx(TABLE, abs=1e-4)
    assert (landed["target_pos"] - landed["tool_pos"])[:2].abs().max() < 0.065 - TABLE
    for td in found[start : start + 30]:
        assert (td["goal"] - td["tool_pos"])[:2].norm() < 0.03 + 1e-5


def test_after_a_miss_it_goes_up_to_the_next_meeting():
    scene, planner = line(), make_planner()
    found = scene.run(planner, 30)
    while found[-1]["plan", "drop_step"] < 0:
        found += scene.run(planner, 1, found[-1]["plan"])
    scene.velocity = torch.tensor([-0.02, 0.02, 0.0])
    escape = scene.run(planner, 9, found[-1]["plan"])
    assert (torch.stack([td["goal"][2] for td in escape[:8]]) == TABLE).all()
    assert int(escape[-1]["plan", "drop_step"]) == -1
    assert escape[-1]["goal"][2].item() == pytest.approx(ABOVE)
    scene.velocity = torch.tensor([0.0, 0.0, 0.0])
    again = scene.run(planner, 120, escape[-1]["plan"])
    steps = [int(td["plan", "drop_step"]) for td in again]
    assert steps[0] == -1
    assert max(steps) >= 0
    landed = again[steps.index(15)]
    assert (landed["target_pos"] - landed["tool_pos"]).abs().max() < 0.02


def test_plans_at_steps_13_18_23_and_stays_until_the_first():
    found = world(2).run(make_planner(), 40)
    due = [step for step, td in enumerate(found) if td["plan", "replanned"].all()]
    assert due == list(range(13, 40, 5))
    assert all(torch.equal(td["goal"], found[0]["tool_pos"]) for td in found[:13])
    planner = make_planner()
    world(2).run(planner, 40)
    assert len(planner.eta.shapes) == len(planner.forecaster.rows) == len(due)


def test_the_place_of_a_kept_meeting_does_not_move_from_plan_to_plan():
    found = line().run(make_planner(), 140)
    start = next(step for step, td in enumerate(found) if int(td["plan", "drop_step"]) >= 0)
    goals = torch.stack([td["goal"] for td in found[13:start]])
    assert sum(bool(td["plan", "replanned"]) for td in found[13:start]) > 5
    torch.testing.assert_close(goals, goals[:1].expand_as(goals), rtol=0, atol=1e-5)


def test_a_meeting_is_kept_and_comes_one_step_nearer():
    found = line().run(make_planner(), 36)
    for before, td in itertools.pairwise(found[13:]):
        change = int(before["arrival_steps"]) - 1 - int(td["arrival_steps"])
        assert abs(change) <= (SEARCH.stride + 1 if td["plan", "replanned"] else 0)
    assert torch.equal(found[17]["plan", "goal"][2:], torch.tensor([ABOVE]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_a_batch_is_a_loop_over_its_rows(batch, dtype):
    scene = world(*batch, dtype=dtype)
    rows = [value.reshape(-1, 3) for value in (scene.trace[..., -1, :], scene.velocity, scene.tool)]
    together = scene.run(make_planner(), 110)
    assert together[-1]["goal"].dtype == dtype
    assert any((td["plan", "drop_step"] >= 0).any() for td in together)
    for row in reversed(range(len(rows[0]))):
        alone = World(*(value[row] for value in rows)).run(make_planner(), 110)
        for td, single in zip(together, alone, strict=True):
            assert_same(td.reshape(-1)[row], single)


def test_rows_at_step_0_start_afresh_and_leave_the_others_alone():
    planner, scene, untouched = make_planner(), world(4), world(4)
    plan = scene.run(planner, 75)[-1]["plan"]
    fresh = world(4, seed=1)
    reset = torch.tensor([True, False, True, False])
    for name in ("trace", "velocity", "tool", "step_count"):
        old, new = getattr(scene, name), getattr(fresh, name)
        setattr(scene, name, torch.where(reset.reshape(-1, *[1] * (old.ndim - 1)), new, old))
    found = scene.run(planner, 75, plan)
    started, going_on = fresh.run(make_planner(), 75), untouched.run(make_planner(), 150)[75:]
    for td, new, old in zip(found, started, going_on, strict=True):
        assert_same(td[reset], new[reset])
        assert_same(td[~reset], old[~reset])
    assert any((td["plan", "drop_step"] >= 0)[reset].any() for td in found)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_forecast_that_is_not_finite_holds_its_row_until_the_next(bad):
    planner, scene = make_planner(), world(6, seed=3)
    scene.trace[:3, :, 1], scene.trace[3:, :, 1] = -0.3, 0.3
    scene.velocity[:, 1] = 0.0
    planner.forecaster.broken = bad
    found = scene.run(planner, 30)
    for td in found[13:]:
        assert td["plan", "reachable"].tolist() == [False] * 3 + [True] * 3
        assert all(torch.isfinite(td[key]).all() for key in ("goal", "action", ("plan", "path")))
        assert torch.equal(td["goal"][:3], found[0]["tool_pos"][:3])
        assert (td["plan", "drop_step"] == -1).all()
    planner.forecaster.broken = None
    well = scene.run(planner, 4, found[-1]["plan"])[-1]
    assert well["plan", "reachable"].all()
    assert well["goal"][:, 2].tolist() == pytest.approx([ABOVE] * 6)


def test_a_short_forecast_goes_on_at_its_last_place():
    planner = make_planner()
    planner.forecaster.horizon = 9
    found = world(3).run(planner, 20)
    path = found[13]["plan", "path"]
    assert path.shape == (3, DROP.lookahead + 8, 3)
    assert torch.equal(path[:, 9:], path[:, 9:10].expand(-1, DROP.lookahead - 1, -1))


def test_keys_are_declared_and_written():
    planner, scene = make_planner(), world(2)
    written = set(scene.run(planner, 1)[0].keys(True, True)) - {"plan"}
    assert written == set(planner.in_keys) | set(planner.out_keys)
    assert {("plan", name) for name in DropState._fields} <= written


def test_a_missing_key_is_named():
    with pytest.raises(InputError, match=r"DynamicPlanner reads the key 'tool_pos'"):
        make_planner()(TensorDict({}, ()))


BAD = [("drop_height", float("nan"))]
BAD += [("aim_ahead_steps", value) for value in (-1, DROP.lookahead, 2.5)]
BAD += [(name, -1) for name in ("follow_after", "min_drop_steps", "max_drop_steps")]
BAD += [(name, -0.5) for name in ("pull", "half_extent", "begin_above", "down_below", "missed_by")]


@pytest.mark.parametrize(("name", "value"), BAD)
def test_a_bad_setting_is_named(name, value):
    with pytest.raises(InputError, match=f"{name}.*{value}"):
        dataclasses.replace(MANEUVER, **{name: value})


@pytest.mark.parametrize("latency", [0, 4])
def test_by_events_it_plans_seldom_and_still_drops(latency):
    delivery = {"delivery": Delayed(latency)} if latency else {}
    replans = []
    for planner in (make_planner(schedule=EventSchedule(maximum=50), **delivery), make_planner(**delivery)):
        found = line().run(planner, 140)
        drops = [step for step, td in enumerate(found) if int(td["plan", "drop_step"]) == 0]
        replans.append(int(found[drops[0]]["plan", "replans"]))
    assert replans[0] < replans[1] / 2
