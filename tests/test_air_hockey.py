"""The planner of `benchmarks/air_hockey.py`, without the challenge: where its mallet meets the puck, and how fast."""

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
    return importlib.import_module("air_hockey")


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
        "puck_radius": 0.03,
        "mallet_radius": 0.05,
        "control_step": STEP,
    }


@pytest.mark.parametrize("velocity", [(-1.2, -0.5), (-2.2, 0.1), (0.2, 0.3)], ids=["bounces", "fast", "goes away"])
def test_the_mallet_is_there_and_gives_way_within_its_limits(hockey, tmp_path, velocity):
    about, rim = described(tmp_path), 1.038 / 2 - 0.03
    agent = hockey.Agent(about)
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
