"""Contact without a jolt, on a toy belt: where the target is, and as fast as it is."""

import pytest
import torch
from tensordict import TensorDict

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import ConstantVelocity
from torchdyn_plan.planners import (
    DynamicPlanner,
    MatchPhase,
    MatchVelocity,
    ProportionalController,
    ReplanSchedule,
)

STRIDE = 0.03
"""What the toy's tool covers at most along each axis in a control step [m]; it lags by that one step."""
HOVER, DESCENT, HOLD = 0.1, 20, 5
MANEUVER = MatchVelocity(hover=HOVER, descent_steps=DESCENT, hold_steps=HOLD, lift=0.2)


def make_planner(maneuver=MANEUVER, coordinates=3, **parts):
    def steps(robot_state, goal):
        return (goal - robot_state).abs().amax(-1) / STRIDE

    search = maneuver.search(coordinates=coordinates)
    static = ProportionalController(gain=1.0 / STRIDE)
    schedule = ReplanSchedule.every(3, first_step=1)
    own = {"search": search, "schedule": schedule, "maneuver": maneuver}
    return DynamicPlanner(static, ConstantVelocity(horizon=150), steps, **(own | parts)).eval()


def run(planner, start, velocity, steps=140, *, shoved=None, at_step=None):
    """What happens on the belt: places of tools and targets, goals and phases, ``(N, steps, …)`` each.

    Targets go from ``start`` (N, D) with ``velocity`` (N, D) a step, and are ``shoved`` (D,) ``at_step``.
    """
    start, velocity = torch.as_tensor(start), torch.as_tensor(velocity)
    tool, memory, found = torch.zeros_like(start), None, []
    trace = start.unsqueeze(1).repeat(1, 6, 1)
    for step in range(steps):
        seen = {"tool_pos": tool, "robot_state": tool, "target_pos": trace[:, -1], "target_history": trace}
        td = TensorDict(seen | {"step_count": torch.full((len(start),), step)}, batch_size=[len(start)])
        if memory is not None:
            td["plan"] = memory
        td = planner(td)
        memory = td["plan"]
        phase = planner.maneuver.phase(memory["match_step"])
        found.append((tool, trace[:, -1], td["goal"], phase))
        tool = tool + STRIDE * td["action"]
        moved = trace[:, -1] + velocity
        if shoved is not None and step == at_step:
            moved = moved + torch.tensor(shoved)
        trace = torch.cat([trace[:, 1:], moved.unsqueeze(1)], dim=1)
    return [torch.stack(values, 1) for values in zip(*found, strict=True)]


BELT = torch.tensor([[-0.8, 0.4, 0.1], [-1.2, -0.3, 0.0], [0.4, 0.5, -0.2], [-1.0, 0.2, -0.4]])
SPEEDS = torch.tensor([[0.010, 0.0, 0.0], [0.016, 0.0, 0.0], [0.0, 0.0, 0.0], [0.008, -0.004, 0.002]])


def contact(phase):
    """Step of each row's contact: the first on the target."""
    return (phase >= MatchPhase.HOLD).int().argmax(1)


def at(values, steps):
    return values[torch.arange(len(values)), steps]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_at_contact_place_and_velocity_are_the_targets(dtype):
    tool, target, _, phase = run(make_planner(), BELT.to(dtype), SPEEDS.to(dtype))
    assert (phase == MatchPhase.LIFT).any(1).all()
    step = contact(phase)
    torch.testing.assert_close(at(tool, step), at(target, step), atol=2e-4, rtol=0)
    # The step that ends with the contact, and the one that begins with it.
    for end, most in ((step, 1.5e-3), (step + 1, 1e-5)):
        torch.testing.assert_close(at(tool, end) - at(tool, end - 1), SPEEDS.to(dtype), atol=most, rtol=0)


def test_it_hovers_flies_along_and_only_then_comes_down_without_leaps():
    tool, target, _, phase = run(make_planner(), BELT, SPEEDS)
    step = contact(phase)
    begun = (phase == MatchPhase.DOWN).int().argmax(1)
    assert (step - begun == DESCENT).all()
    # It has waited above the place of contact: that is where the target is then.
    above = at(target, step) + torch.tensor([0.0, 0.0, HOVER])
    waited = at(tool, begun)
    torch.testing.assert_close(waited[:2], above[:2], atol=2e-2, rtol=0)
    for row, at_step in enumerate(step.tolist()):
        way = tool[row, at_step - DESCENT : at_step + 1] - target[row, at_step - DESCENT : at_step + 1]
        aside, high = way[:, :2].norm(dim=-1), way[:, 2]
        # When it is low, it flies along with the target.
        assert (aside[high < 0.5 * HOVER] < 0.01).all()
        assert (high > -1e-3).all()
    assert (tool.diff(dim=1).diff(dim=1).norm(dim=-1)[:, begun.max() : step.min()] < 0.02).all()


def test_it_stays_on_the_target_then_rises_and_comes_to_rest():
    tool, target, _, phase = run(make_planner(), BELT, SPEEDS)
    step = contact(phase)
    for after in range(HOLD):
        assert (at(phase, step + after) == MatchPhase.HOLD).all()
        torch.testing.assert_close(at(tool, step + after), at(target, step + after), atol=3e-4, rtol=0)
    lifted = step + HOLD
    assert (at(phase, lifted) == MatchPhase.LIFT).all()
    risen = tool[:, -1, 2] - at(tool, lifted)[:, 2]
    torch.testing.assert_close(risen, 0.2 + 0.5 * DESCENT * SPEEDS[:, 2], atol=5e-3, rtol=0)
    assert (tool[:, -1] - tool[:, -2]).norm(dim=-1).max() < 1e-5


def test_a_target_that_was_missed_is_hovered_over_again():
    planner = make_planner(MatchVelocity(hover=HOVER, descent_steps=DESCENT, hold_steps=HOLD, within=0.02))
    start, velocity = torch.tensor([[-0.6, 0.4, 0.0]]), torch.tensor([[0.008, 0.0, 0.0]])
    *_, phase = run(planner, start, velocity)
    assert (phase.diff(dim=1) >= 0).all()
    # Pushed aside when it is too late to follow: the tool comes down beside it, and tries again.
    begun = (phase[0] == MatchPhase.DOWN).int().argmax().item()
    late = {"shoved": (0.0, 0.3, 0.0), "at_step": begun + DESCENT - 2}
    tool, target, _, phase = run(planner, start, velocity, **late)
    step = contact(phase)
    assert step > begun + DESCENT
    assert (phase[0].diff() < 0).sum() == 1
    torch.testing.assert_close(at(tool, step), at(target, step), atol=1e-3, rtol=0)
    # One that misses nothing by definition holds where the target is not.
    never = make_planner(MatchVelocity(hover=HOVER, descent_steps=DESCENT, hold_steps=HOLD))
    tool, target, _, phase = run(never, start, velocity, **late)
    assert contact(phase) == begun + DESCENT
    assert (at(tool, contact(phase)) - at(target, contact(phase))).norm() > 0.1


def test_a_plane_has_an_axis_too_and_any_axis_will_do():
    across = MatchVelocity(hover=HOVER, descent_steps=DESCENT, hold_steps=HOLD, axis=(0.0, -2.0))
    tool, target, _, phase = run(make_planner(across, coordinates=2), BELT[:, :2], SPEEDS[:, :2])
    step = contact(phase)
    torch.testing.assert_close(at(tool, step), at(target, step), atol=3e-4, rtol=0)
    begun = step - DESCENT // 2
    assert ((at(target, begun) - at(tool, begun))[:, 1] > 0.02).all()


def test_a_batch_is_its_rows_whenever_they_begin():
    together = run(make_planner(), BELT, SPEEDS)
    for row in range(len(BELT)):
        alone = run(make_planner(), BELT[row : row + 1], SPEEDS[row : row + 1])
        for one, all_of_them in zip(alone, together, strict=True):
            torch.testing.assert_close(one[0], all_of_them[row], atol=1e-5, rtol=0)


def test_rows_that_cannot_plan_hold_still_and_begin_nothing():
    planner = make_planner()
    trace = torch.full((2, 6, 3), torch.nan)
    tool = torch.rand(2, 3)
    seen = {"tool_pos": tool, "robot_state": tool, "target_pos": trace[:, -1], "target_history": trace}
    td = planner(TensorDict(seen | {"step_count": torch.zeros(2, dtype=torch.int64)}, batch_size=[2]))
    td["step_count"] += 1
    td = planner(td)
    assert torch.equal(td["goal"], tool)
    assert (td["plan", "match_step"] == -1).all()


def test_it_is_saved_with_its_planner(tmp_path):
    planner = make_planner(MatchVelocity(hover=0.1, descent_steps=9, axis=(0.0, 0.0, 1.0)))
    planner.save_pretrained(tmp_path)
    own = {"static": planner.static, "eta": planner.eta}
    assert DynamicPlanner.from_pretrained(tmp_path, **own).maneuver == planner.maneuver


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hover": -0.1}, "hover must be"),
        ({"descent_steps": 0}, "descent_steps must be"),
        ({"hold_steps": -1}, "hold_steps must be"),
        ({"lift": -1.0}, "lift must be"),
        ({"lift_steps": 0}, "lift_steps must be"),
        ({"along_by": 0.0}, "along_by must be"),
        ({"down_after": 1.0}, "down_after must be"),
        ({"within": 0.0}, "within must be positive"),
        ({"axis": (0.0, 0.0, 0.0)}, "axis must be a direction"),
        ({"axis": (1.0,)}, "axis must be two or three numbers"),
        ({"axis": (1.0, 0.0, float("nan"))}, "axis must be a finite number"),
    ],
)
def test_nonsense_is_named(change, message):
    with pytest.raises(InputError, match=message):
        MatchVelocity(**{"hover": 0.1, "descent_steps": 5, **change})


def test_an_axis_of_another_space_is_named():
    flat = MatchVelocity(hover=0.1, descent_steps=5, axis=(0.0, 1.0))
    with pytest.raises(InputError, match="axis has 2 numbers, but positions have 3 coordinates"):
        flat.search()
    with pytest.raises(InputError, match="axis has 2 numbers, but positions have 3 coordinates"):
        run(make_planner(MANEUVER).with_parts(maneuver=flat), BELT, SPEEDS, steps=3)


def test_who_hovers_upstream_is_as_exact_and_goes_less_far_back():
    early = MatchVelocity(hover=HOVER, descent_steps=DESCENT, hold_steps=HOLD, early_steps=6)
    assert early.search().early_steps == 6
    tool, target, _, phase = run(make_planner(early), BELT[:2], SPEEDS[:2])
    here = contact(phase)
    assert (at(tool, here) - at(target, here)).norm(dim=-1).max() < 2e-3
    plain = run(make_planner(), BELT[:2], SPEEDS[:2])

    def back(tool):
        return -tool[..., 0].diff(dim=1).clamp(max=0.0).sum(1)

    assert (back(tool) < back(plain[0]) + 0.01).all()
