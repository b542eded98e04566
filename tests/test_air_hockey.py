"""The planners of `benchmarks/air_hockey.py`, without the challenge: where the mallet meets the puck, and how fast."""

import importlib
import math
from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
STEP, DRAG = 0.02, 0.497
ARM = """
<mujoco><compiler angle="radian"/><worldbody><body name="base">
  <body name="first" pos="0 0 0.1"><joint name="a" axis="0 0 1" range="-2.9 2.9"/><geom size="0.01"/>
    <body name="second" pos="0.55 0 0"><joint name="b" axis="0 0 1" range="-1.8 1.8"/><geom size="0.01"/>
      <body name="third" pos="0.44 0 0"><joint name="c" axis="0 0 1" range="-2.1 2.1"/><geom size="0.01"/>
        <body name="mallet" pos="0.44 0 0"><geom size="0.01"/></body>
      </body>
    </body>
  </body>
</body></worldbody></mujoco>
"""


@pytest.fixture
def hockey(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return lambda name: importlib.import_module(f"air_hockey_{name}")


def described(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    return {
        "file": str(tmp_path / "arm.xml"),
        "base": "base",
        "mallet": "mallet",
        "base_x": -1.51,
        "height": 0.1,
        "joint_vel": [1.57, 1.57, 2.09],
        "joint_acc": [6.28, 6.28, 8.38],
        "length": 1.948,
        "width": 1.038,
        "goal_width": 0.25,
        "puck_radius": 0.03,
        "mallet_radius": 0.05,
        "control_step": STEP,
    }


@pytest.mark.parametrize("velocity", [(-1.2, -0.5), (-2.2, 0.1), (0.2, 0.3)], ids=["bounces", "fast", "goes away"])
def test_the_mallet_is_there_and_gives_way_within_its_limits(hockey, tmp_path, velocity):
    about, rim = described(tmp_path), 1.038 / 2 - 0.03
    agent = hockey("defend").Defender(about)
    puck, velocity = torch.tensor([0.45, -0.24]), torch.tensor(velocity)
    joints, speeds, places = [-1.156, 1.3, 1.443], [0.0] * 3, []
    for _ in range(70):
        seen = {"puck_pos": [puck[0].item() + 1.51, puck[1].item(), 0.0], "puck_vel": [*velocity.tolist(), 0.0]}
        before, slower = torch.tensor(joints), torch.tensor(speeds)
        with torch.no_grad():
            joints, speeds = agent.act(seen | {"joint_pos": joints, "joint_vel": speeds})
        # Speeds change evenly within the step, and not faster than the acceleration limit.
        mean, change = 0.5 * (slower + torch.tensor(speeds)), torch.tensor(speeds) - slower
        torch.testing.assert_close(torch.tensor(joints) - before, STEP * mean, atol=1e-5, rtol=0.0)
        assert (change.abs() <= agent.own.quick * STEP * torch.tensor(about["joint_acc"]) + 1e-5).all()
        places.append(agent.state["tool_pos"][0])
        assert all(abs(speed) <= 0.9 * most for speed, most in zip(speeds, about["joint_vel"], strict=True))
        if (places[-1][:2] - puck).norm() < 0.0799:
            break
        velocity = velocity * math.exp(-DRAG * STEP)
        puck = puck + STEP * velocity
        if puck[1].abs() > rim:
            puck[1], velocity = puck[1].clamp(-rim, rim), velocity * torch.tensor([0.95, -0.85])
    if velocity[0] > 0.0:
        # It never comes into the zone: nothing is done about it.
        assert (torch.stack(places) - places[0]).abs().max() < 1e-3
        return
    assert -0.76 < puck[0] < -0.2
    normal = torch.nn.functional.normalize(places[-1][:2] - puck, dim=-1)
    assert normal @ velocity > 0.98 * velocity.norm()
    given = (places[-1] - places[-2])[:2] / STEP
    assert abs(given @ normal / velocity.norm() - 0.33) < 0.08


def test_a_struck_puck_leaves_as_asked(hockey):
    torch.manual_seed(0)
    before, leaves, share = torch.randn(20, 2), torch.randn(20, 2), 0.4
    normal, comes = hockey("hit").strike(before, leaves, share)
    # A contact without friction changes the speed along the normal, to 1 + e times the difference.
    closing = ((comes - before) * normal).sum(-1, keepdim=True)
    torch.testing.assert_close(before + (1.0 + share) * closing * normal, leaves)
    # Nor would friction do anything: there is no speed across.
    torch.testing.assert_close(comes - before, closing * normal)
    assert (closing > 0.0).all()


@pytest.mark.parametrize(
    ("puck", "velocity"),
    [((-0.55, 0.3), (0.0, 0.0)), ((-0.5, 0.0), (-0.1, 0.4))],
    ids=["stands", "crosses"],
)
def test_the_mallet_shoots_the_puck_into_the_goal_within_its_limits(hockey, tmp_path, puck, velocity):
    about = described(tmp_path)
    agent = hockey("hit").Hitter(about)
    puck, velocity = torch.tensor(puck), torch.tensor(velocity)
    joints, speeds, places = [-1.156, 1.3, 1.443], [0.0] * 3, []
    for _ in range(60):
        seen = {"puck_pos": [puck[0].item() + 1.51, puck[1].item(), 0.0], "puck_vel": [*velocity.tolist(), 0.0]}
        with torch.no_grad():
            joints, speeds = agent.act(seen | {"joint_pos": joints, "joint_vel": speeds})
        places.append(agent.state["tool_pos"][0, :2])
        assert all(abs(speed) <= 0.9 * most for speed, most in zip(speeds, about["joint_vel"], strict=True))
        # It plans for half a control step later, when the puck is there.
        if (places[-1] - puck - 0.5 * STEP * velocity).norm() < 0.0805:
            break
        velocity = velocity * math.exp(-DRAG * STEP)
        puck = puck + STEP * velocity
    normal = torch.nn.functional.normalize(puck + 0.5 * STEP * velocity - places[-1], dim=-1)
    comes = (places[-1] - places[-2]) / STEP
    leaves = velocity + (1.0 + agent.own.restitution) * ((comes - velocity) @ normal) * normal
    assert leaves[0] > 0.9
    # Well inside the posts: the goal is 0.25 m wide, the puck 0.06 m.
    assert abs(puck[1] + (0.974 - puck[0]) * leaves[1] / leaves[0]) < 0.07


def test_a_puck_in_the_own_goal_is_not_waited_for(hockey, tmp_path):
    agent = hockey("hit").Hitter(described(tmp_path))
    history = torch.tensor([[[-0.7, 0.05, 0.1], [-0.712, 0.05, 0.1]], [[-0.7, 0.3, 0.1], [-0.712, 0.3, 0.1]]])
    begins = agent.planner.forecaster.predict(history).path
    # Both come back from the rim: one between the posts, where there is none.
    assert (begins[0, 60:] > 50.0).all()
    assert (begins[1, 60:] < 1.0).all(-1).any()


def test_a_waiting_mallet_lets_the_puck_pass(hockey, tmp_path):
    strike = hockey("hit").Hitter(described(tmp_path)).planner.maneuver
    path = torch.stack([torch.linspace(-0.7, -0.94, 40), torch.full((40,), 0.3), torch.full((40,), 0.1)], dim=-1)
    place, tool = torch.tensor([[-0.8, 0.31, 0.1]]), torch.tensor([[-0.8, 0.1, 0.1]])
    moved = strike._aside(place, path[None], tool)
    assert moved[0, 1] < 0.3
    assert torch.cdist(moved, path).amin() > 0.08 + 0.9 * strike.clearance
    far = torch.tensor([[-0.8, 0.1, 0.1]])
    torch.testing.assert_close(strike._aside(far, path[None], tool), far)
