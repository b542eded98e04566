"""Arms that are not Trapper's: without an approach of its own an arm goes straight to its goal."""

import math

import pytest
import torch
from tensordict import TensorDict

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, Joint
from torchdyn_plan.kinematics.joint import transform
from torchdyn_plan.planners import IKPlanner, StraightToGoal

STEP = 0.004
PANDA = [
    (0, 0.333, 0),
    (0, 0, -math.pi / 2),
    (0, 0.316, math.pi / 2),
    (0.0825, 0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0, 0, math.pi / 2),
    (0.088, 0.107, math.pi / 2),
]
"""Length, offset and twist of each link [m; rad], as Craig counts them."""
HOME = torch.tensor([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8])
GOALS = torch.tensor([[0.5, 0.0, 0.3], [0.4, 0.3, 0.5], [0.3, -0.4, -0.1], [0.55, 0.1, 0.0]])
"""Well within reach, above and below the base, and far from where Trapper's table would allow."""


def seven_joints(dtype=torch.float64):
    joints = []
    for number, (length, offset, twist) in enumerate(PANDA):
        turn = [[1, 0, 0], [0, math.cos(twist), -math.sin(twist)], [0, math.sin(twist), math.cos(twist)]]
        place = (length, -offset * math.sin(twist), offset * math.cos(twist))
        joints.append(
            Joint(
                offset=transform(torch.tensor(turn, dtype=torch.float64), place),
                kind="revolute",
                axis=torch.tensor([0.0, 0, 1.0], dtype=torch.float64),
                name=f"joint_{number}",
                lower=-2.8,
                upper=2.8,
                speed_limit=2.0,
            )
        )
    return Arm(joints, dtype=dtype)


def drive(planner, goal, steps=400, base=(0.0, 0.0, 0.0)):
    """Tool places (steps + 1, *B, 3) [m, world] of arms that do exactly what ``planner`` says, from `HOME`."""
    batch = goal.shape[:-1]
    joint_pos = HOME.to(goal.dtype).expand(*batch, 7)
    place = [planner.arm(joint_pos)[..., :3, 3]]
    plan = None
    for step in range(steps):
        entries = {"joint_pos": joint_pos, "goal": goal, "step_count": torch.full(batch, step)}
        td = TensorDict(entries, batch)
        td = planner(td if plan is None else td.set("plan", plan))
        plan = td["plan"]
        joint_pos = joint_pos + td["action"] * planner.arm.speed_limit * STEP
        place.append(planner.arm(joint_pos)[..., :3, 3])
    return torch.stack(place) + torch.tensor(base, dtype=goal.dtype)


@pytest.mark.parametrize("batch", [(), (4,), (2, 2)])
def test_it_comes_to_its_goal_whatever_the_batch(batch):
    goal = GOALS.double()[: max(1, math.prod(batch))].reshape(*batch, 3)
    place = drive(IKPlanner(seven_joints()), goal)
    assert place.shape == (401, *batch, 3)
    assert (place[-1] - goal).norm(dim=-1).max() < 1e-3


def test_the_way_is_straight():
    goal = GOALS.double()[:2]
    place = drive(IKPlanner(seven_joints()), goal)
    way = goal - place[0]
    along = ((place - place[0]) * way).sum(-1, keepdim=True) / way.square().sum(-1, keepdim=True)
    aside = (place - place[0] - along * way).norm(dim=-1)
    assert aside.max() < 0.05 * way.norm(dim=-1).max()
    assert bool((along.diff(dim=0) > -1e-6).all())


def test_rows_are_as_if_alone():
    planner, goal = IKPlanner(seven_joints()), GOALS.double()
    together = drive(planner, goal, 40)
    for row in range(4):
        torch.testing.assert_close(together[:, row], drive(planner, goal[row], 40))


def test_the_base_may_stand_anywhere():
    base, goal = (1.0, -2.0, 0.7), GOALS.double()
    elsewhere = IKPlanner(seven_joints(), approach=StraightToGoal(base_pos=base))
    moved = drive(elsewhere, goal + torch.tensor(base), 60, base)
    torch.testing.assert_close(moved - torch.tensor(base), drive(IKPlanner(seven_joints()), goal, 60))
    with pytest.raises(InputError, match="base_pos"):
        StraightToGoal(base_pos=(0.0, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("batch", [(), (4,), (2, 2)])
def test_the_compiled_planner_does_the_same(batch):
    goal = GOALS[: max(1, math.prod(batch))].reshape(*batch, 3)
    arm = seven_joints(torch.float32)
    fast, plain = IKPlanner(arm, compiled=True), IKPlanner(arm)
    torch.testing.assert_close(drive(fast, goal, 60), drive(plain, goal, 60), atol=1e-4, rtol=0)


@pytest.mark.parametrize("bad", [None, "ur5", 6])
def test_without_an_arm_one_sentence_says_what_is_missing(bad):
    with pytest.raises(InputError, match=r"arm must be an Arm, such as Arm.ur5\(\) or Arm.from_urdf\(...\), got \w+$"):
        IKPlanner(bad)
