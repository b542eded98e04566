"""Arms out of URDF as people have it."""

import math
import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

from tests.kinematics.arms import ARMS, Row, configurations, product_of_transforms, urdf
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, Coupling, Joint, compiled_pose_and_jacobian, solve_ik
from torchdyn_plan.kinematics.joint import transform
from torchdyn_plan.planners.static.ik import IKPlanner

TEXT = urdf(ARMS["panda"])
DOUBLE = {"dtype": torch.float64}


def same(one, other):
    """Whether two arms are the same to the last bit."""
    q = configurations(5, one.num_joints)
    limits = ("lower", "upper", "speed_limit")
    return all(
        torch.equal(a, b)
        for a, b in zip(
            (*one.pose_and_jacobian(q), *(getattr(one, name) for name in limits)),
            (*other.pose_and_jacobian(q), *(getattr(other, name) for name in limits)),
            strict=True,
        )
    )


ANYTHING = {
    "transmission of PR2": '<transmission type="pr2_mechanism_model/SimpleTransmission" name="t">'
    '<actuator name="m"/><joint name="joint1"/><mechanicalReduction>1</mechanicalReduction></transmission>',
    "transmission without a joint": '<transmission name="t"><type>x</type></transmission>',
    "transmission of Valkyrie": '<transmission name="t" type="v1"><joint name="joint1"/><hardwareInterface/>'
    "</transmission>",
    "texture without a file": '<material name="m"><texture/></material>',
    "colour of three numbers": '<material name="m"><color rgba="1 0 0"/></material>',
    "scale of one number": '<link name="x"><visual><geometry><mesh filename="m" scale="1"/></geometry></visual></link>',
    "undeclared prefix": '<gazebo><controller:x interface:name="y"/></gazebo>',
    "floating joint elsewhere": '<link name="x"/><joint name="f" type="floating"><parent link="link0"/>'
    '<child link="x"/></joint>',
    "joint of no kind elsewhere": '<joint name="f" type="spring"><parent link="tool"/><child link="nowhere"/></joint>',
    "sensor": '<sensor name="s"><ray/></sensor>',
    "two roots": '<link name="alone"/>',
    "NaN elsewhere": '<link name="x"/><joint name="f" type="fixed"><origin xyz="nan 0 0"/><parent link="link0"/>'
    '<child link="x"/></joint>',
}


@pytest.mark.parametrize("more", ANYTHING.values(), ids=ANYTHING)
def test_what_an_arm_does_not_need_is_not_read(more, capfd):
    arm = Arm.from_urdf(TEXT.replace("</robot>", more + "</robot>"), tip="tool", **DOUBLE)
    assert same(arm, Arm.from_urdf(TEXT, tip="tool", **DOUBLE))
    assert capfd.readouterr() == ("", "")


def test_a_limit_needs_no_effort_and_unknown_attributes_say_nothing(capfd):
    text = (
        TEXT.replace('effort="1" ', "")
        .replace("<axis ", '<axis colour="red" ')
        .replace("<robot ", '<robot version="1" ')
    )
    assert same(Arm.from_urdf(text, tip="tool", **DOUBLE), Arm.from_urdf(TEXT, tip="tool", **DOUBLE))
    assert capfd.readouterr() == ("", "")


def test_a_description_comes_as_text_as_bytes_or_as_a_file(tmp_path):
    file, expected = tmp_path / "arm.urdf", Arm.from_urdf(TEXT, tip="tool")
    file.write_text(TEXT)
    declared = '<?xml version="1.0" encoding="latin-1"?><!-- Fräse -->' + TEXT
    for source in (TEXT.encode(), file, str(file), "\n " + TEXT, declared, declared.encode("latin-1")):
        assert torch.equal(Arm.from_urdf(source, tip="tool")(torch.ones(7)), expected(torch.ones(7)))


def test_the_last_link_and_a_link_in_the_middle_are_tips():
    rows = ARMS["panda"]
    q = configurations(5, 4)
    arm = Arm.from_urdf(TEXT, tip="link5", base="link1", **DOUBLE)
    torch.testing.assert_close(arm(q), product_of_transforms(rows[1:5], q), atol=1e-12, rtol=0)


def joint(name, parent, child, kind="revolute", more='<limit lower="-1" upper="1" effort="1" velocity="1"/>'):
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{more}</joint>'


def robot(*joints, links="abcd"):
    return '<robot name="r">' + "".join(f'<link name="{link}"/>' for link in links) + "".join(joints) + "</robot>"


AB = joint("first", "a", "b")
WRONG = {
    "undeclared child": (
        robot(AB, joint("second", "b", "body")),
        "body",
        "joint 'second' names the link 'body', which",
    ),
    "undeclared parent": (robot(joint("second", "body", "b")), "b", "joint 'second' names the link 'body', which"),
    "loop": (
        robot(joint("first", "a", "b"), joint("second", "b", "a")),
        "b",
        "the joints 'first', 'second' form a loop",
    ),
    "two parents": (robot(AB, joint("second", "c", "b")), "b", "'first', 'second' all lead to the link 'b'"),
    "no such file": ("robots/arm.urdf", "b", "'robots/arm.urdf' is neither a description nor a file"),
    "no description": (7, "b", "URDF comes as text or as a path, got int"),
    "not closed": ("<robot><link name='b'>", "b", "cannot be read: no element found"),
    "MJCF": ("<mujoco/>", "b", "its root is <mujoco>, not <robot>"),
    "macros": ("<robot><link name='b'/><xacro:arm/></robot>", "b", "holds the macro <xacro:arm>: expand it"),
    "no link": ("<robot/>", "b", "declares no link"),
    "joints of one name": (robot(AB, joint("first", "b", "c")), "c", "2 joints are named 'first': .* links 'b', 'c'"),
    "links of one name": (robot(AB, links="aabb"), "b", "the link 'b' is declared 2 times"),
    "no name": (robot(joint("", "a", "b")), "b", "the joint that leads to the link 'b' has no name"),
    "no parent": (robot(AB.replace('<parent link="a"/>', "")), "b", "joint 'first' names no parent link"),
    "kind": (robot(joint("first", "a", "b", "spring")), "b", "joint of type 'spring'.* It is 'first'.*the link 'b'"),
    "NaN in a place": (
        robot(joint("first", "a", "b", more='<origin xyz="0 nan 0"/>')),
        "b",
        "'first' has xyz='0 nan 0'",
    ),
    "NaN in a turn": (
        robot(joint("first", "a", "b", more='<origin rpy="0 inf 0"/>')),
        "b",
        "'first' has rpy='0 inf 0'",
    ),
    "two numbers": (
        robot(joint("first", "a", "b", more='<origin xyz="0 1"/>')),
        "b",
        "xyz='0 1' .*not 3 finite numbers",
    ),
    "no number": (robot(joint("first", "a", "b", more='<axis xyz="x y z"/>')), "b", "'first' has xyz='x y z'"),
    "no axis": (robot(joint("first", "a", "b", more='<axis xyz="0 0 0"/>')), "b", "joint 'first' has no axis"),
    "quaternion": (robot(joint("first", "a", "b", more='<origin quat_xyzw="0 0 0 1"/>')), "b", "'first' .*quat_xyzw"),
    "limits": (
        robot(joint("first", "a", "b", more='<limit lower="2" upper="1" velocity="1"/>')),
        "b",
        "joint 'first' has a lower limit of 2.0 and an upper one of 1.0",
    ),
    "NaN limit": (
        robot(joint("first", "a", "b", more='<limit lower="nan" upper="1"/>')),
        "b",
        "'first' has lower='nan'",
    ),
    "negative speed": (
        robot(joint("first", "a", "b", more='<limit velocity="-1"/>')),
        "b",
        "'first' has a speed limit of",
    ),
}


@pytest.mark.parametrize(("source", "tip", "message"), WRONG.values(), ids=WRONG)
def test_one_error_names_what_is_wrong(source, tip, message, capfd):
    with pytest.raises(InputError, match=message):
        Arm.from_urdf(source, tip=tip)
    assert capfd.readouterr() == ("", "")


def test_a_speed_of_zero_is_none_and_one_error_asks_for_it():
    text = robot(joint("first", "a", "b", more='<limit lower="-1" upper="1" velocity="0"/>'), joint("second", "b", "c"))
    arm = Arm.from_urdf(text, tip="c")
    assert arm.speed_limit.tolist() == [math.inf, 1.0]
    with pytest.raises(InputError, match=r"planner needs the speed limits .* none for 'first': .* speed_limit="):
        arm.needed_speed_limit("planner")
    assert Arm.from_urdf(text, tip="c", speed_limit=[2.0, 3.0]).needed_speed_limit("planner").tolist() == [2.0, 3.0]


# Of four joints, the second follows the fourth and the third the second.
def mimic(of, ratio, shift):
    return f'<limit lower="-9" upper="9" velocity="9"/><mimic joint="{of}" multiplier="{ratio}" offset="{shift}"/>'


def finger(driver_limit='lower="-1" upper="1" velocity="2"', kinds=("revolute",) * 4, ratios=(0.5, -2.0)):
    place = '<origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/><axis xyz="1 2 3"/>'
    more = ["", mimic("fourth", ratios[0], 0.1), mimic("second", ratios[1], -0.2), f"<limit {driver_limit}/>"]
    names, links = ("first", "second", "third", "fourth"), "abcde"
    return robot(
        *(
            joint(names[i], links[i], links[i + 1], kinds[i], place + (more[i] or '<limit lower="-3" upper="3"/>'))
            for i in range(4)
        ),
        links=links,
    )


def uncoupled(text):
    return re.sub("<mimic[^>]*>", "", text)


@pytest.mark.parametrize("kinds", [("revolute",) * 4, ("revolute", "prismatic", "revolute", "prismatic")])
@pytest.mark.parametrize("form", ["auto", "transforms"])
def test_joints_that_mimic_each_other_move_together(kinds, form):
    text = finger(kinds=kinds)
    arm, free = Arm.from_urdf(text, tip="e", form=form, **DOUBLE), Arm.from_urdf(uncoupled(text), tip="e", **DOUBLE)
    assert arm.joint_names == ("first", "fourth")
    assert (arm.joint_kinds, arm.num_joints) == ((kinds[0], kinds[3]), 2)
    q = configurations(6, 2, spread=1.0)
    second = 0.5 * q[:, 1] + 0.1
    whole = torch.stack([q[:, 0], second, -2.0 * second - 0.2, q[:, 1]], dim=-1)
    motion = torch.tensor([[1, 0], [0, 0.5], [0, -1.0], [0, 1]], **DOUBLE)
    pose, jacobian = arm.pose_and_jacobian(q)
    expected = free.pose_and_jacobian(whole)
    torch.testing.assert_close(pose, expected[0], atol=1e-12, rtol=0)
    torch.testing.assert_close(jacobian, expected[1] @ motion, atol=1e-12, rtol=0)
    torch.testing.assert_close(arm(q), pose, atol=1e-12, rtol=0)
    rotation, place, columns = arm.components(q.unbind(-1))
    for row, column in ((rotation[0][1], pose[:, 0, 1]), (place[2], pose[:, 2, 3]), (columns[1][4], jacobian[:, 4, 1])):
        torch.testing.assert_close(row, column, atol=1e-12, rtol=0)
    assert gradcheck(arm.pose_and_jacobian, q[0].clone().requires_grad_())


def test_a_joint_that_follows_one_outside_the_chain_is_moved_by_it():
    text = finger()
    arm, free = Arm.from_urdf(text, tip="c", **DOUBLE), Arm.from_urdf(uncoupled(text), tip="c", **DOUBLE)
    assert arm.joint_names == ("first", "fourth")
    q = configurations(4, 2)
    torch.testing.assert_close(arm(q), free(torch.stack([q[:, 0], 0.5 * q[:, 1] + 0.1], dim=-1)), atol=1e-12, rtol=0)
    assert (arm.lower.tolist(), arm.upper.tolist(), arm.speed_limit.tolist()) == ([-3, -1], [3, 1], [math.inf, 2])


def test_limits_hold_for_all_that_a_joint_moves():
    arm = Arm.from_urdf(finger('lower="-90" upper="90" velocity="90"'), tip="e", **DOUBLE)
    # -9 <= 0.5 q + 0.1 <= 9 and -9 <= -2 (0.5 q + 0.1) - 0.2 <= 9, of which the second is narrower.
    np.testing.assert_allclose([arm.lower[1], arm.upper[1]], [-9.4, 8.6], atol=1e-12)
    assert arm.speed_limit.tolist() == [math.inf, 9.0]
    with pytest.raises(InputError, match="joint 'fourth' moves joint 'second', and their limits leave no position"):
        Arm.from_urdf(finger('lower="80" upper="90" velocity="90"'), tip="e")


def test_a_full_turn_of_a_driver_is_none_where_it_moves_others_by_parts_of_a_turn():
    for ratios, expected in (((0.5, -2.0), (True, False)), ((2.0, -2.0), (True, True)), ((1.0, 0.5), (True, False))):
        assert Arm.from_urdf(finger(ratios=ratios), tip="e").full_turns == expected
    kinds = ("revolute", "prismatic", "revolute", "revolute")
    assert Arm.from_urdf(finger(kinds=kinds, ratios=(1, 1)), tip="e").full_turns == (True, False)
    assert Arm.from_urdf(urdf(ARMS["scara"]), tip="tool").full_turns == (True, True, False, True)


def test_a_multiplier_of_zero_holds_a_joint_where_it_is():
    text = finger(ratios=(0.0, -2.0))
    arm, free = Arm.from_urdf(text, tip="e", **DOUBLE), Arm.from_urdf(uncoupled(text), tip="e", **DOUBLE)
    assert arm.joint_names == ("first", "fourth")
    q = torch.tensor([0.3, -0.4], **DOUBLE)
    torch.testing.assert_close(arm(q), free(torch.tensor([0.3, 0.1, -0.4, -0.4], **DOUBLE)), atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('<mimic joint="nobody"/>', "joint 'first' mimics joint 'nobody', but 0 joints have this name"),
        ('<mimic joint="second"/>', "joint 'first' mimics joint 'second', but it is no joint that moves"),
        ('<mimic joint="first"/>', "the joints 'first' mimic each other in a circle"),
        ("<mimic/>", "joint 'first' mimics joint None"),
        ('<mimic joint="third" multiplier="nan"/>', "joint 'first' has multiplier='nan' in its <mimic>"),
    ],
)
def test_a_mimic_that_cannot_be_is_refused_by_name(more, message):
    text = robot(joint("first", "a", "b", more=more), joint("second", "b", "c", "fixed"), joint("third", "c", "d"))
    with pytest.raises(InputError, match=message):
        Arm.from_urdf(text, tip="d")


def test_a_coupled_arm_does_all_that_an_arm_does():
    arm = Arm.from_urdf(finger(), tip="e", speed_limit=2.0)
    again = Arm(**arm.part_settings())
    q = configurations(7, 2, dtype=torch.float32, spread=0.9)
    assert torch.equal(arm(q), again(q))
    assert torch.equal(arm(q.view(7, 1, 2)), arm(q).view(7, 1, 4, 4))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        for one, other in zip(arm.pose_and_jacobian(q), again.pose_and_jacobian(q), strict=True):
            assert one.dtype == torch.float32
            torch.testing.assert_close(one, other)
        found = arm(q)
    assert torch.equal(found, arm(q))
    result = solve_ik(arm, arm(q))
    assert bool((result.status == 0).all())
    planner = IKPlanner(arm)
    path = planner.path(q, torch.tensor([0.1, 0.2, 0.9]).expand(7, 3))
    assert path.shape == (7, 5, 2)
    assert bool(path.isfinite().all())


def test_a_driver_is_not_turned_on_where_it_moves_others_by_parts_of_a_turn():
    axes = torch.tensor([[0.0, 0, 1], [0, 1, 0], [0, 1, 0]], **DOUBLE)
    places = [transform(position=(0.3, 0, 0)) for _ in range(4)]
    driver, last = (Joint(name=f"j{i}", offset=places[i], kind="revolute", axis=axes[i]) for i in (0, 2))
    follower = Joint(offset=places[1], kind="revolute", axis=axes[1], coupling=Coupling(driver=driver, ratio=0.5))
    arm = Arm([driver, follower, last, Joint(offset=places[3])], **DOUBLE)
    q = configurations(50, 2)
    start = q + torch.tensor([2.0 * math.pi, 0.0], **DOUBLE)
    result = solve_ik(arm, arm(q), q0=start, constraint="position")
    off = (arm(result.q) - arm(q))[..., :3, 3].norm(dim=-1)
    solved = result.status == 0
    assert int(solved.sum()) > 40
    assert float(off[solved].max()) <= 1e-3


@pytest.mark.slow
def test_a_coupled_arm_is_compiled():
    arm = Arm.from_urdf(finger(), tip="e", **DOUBLE)
    q = configurations(5, 2)
    pose, jacobian = compiled_pose_and_jacobian(arm)(q)
    torch.testing.assert_close(pose, arm(q)[:, :3], atol=1e-12, rtol=0)
    torch.testing.assert_close(jacobian, arm.pose_and_jacobian(q)[1], atol=1e-12, rtol=0)


TOOL = transform(torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], **DOUBLE), (0.1, 0.2, 0.3))


def test_a_tool_comes_behind_the_tip():
    bare, q = Arm.from_urdf(TEXT, tip="tool", **DOUBLE), configurations(3, 7)
    for tool in (TOOL, TOOL.tolist(), TOOL.float()):
        arm = Arm.from_urdf(TEXT, tip="tool", tool=tool, **DOUBLE)
        torch.testing.assert_close(arm(q), bare(q) @ TOOL, atol=1e-7 if tool is not TOOL else 1e-12, rtol=0)
        again = Arm(**arm.part_settings())
        assert torch.equal(again(q), arm(q))
    graded = TOOL.clone().requires_grad_()
    Arm.from_urdf(TEXT, tip="tool", tool=graded, **DOUBLE)(q).sum().backward()
    assert graded.grad is not None
    assert float(graded.grad.abs().sum()) > 0.0


@pytest.mark.parametrize(
    ("tool", "message"),
    [
        (torch.eye(3), r"tool must have shape \(4, 4\), got \(3, 3\)"),
        (2.0 * torch.eye(4), "tool must be a rotation and a position"),
        (torch.diag(torch.tensor([1.0, 1, -1, 1])), "tool must be a rotation and a position"),
        (torch.full((4, 4), math.nan), "tool must be finite"),
        ("flange", r"tool must be a pose \(4, 4\) of numbers, got 'flange'"),
    ],
)
def test_a_tool_that_is_no_pose_is_refused(tool, message):
    with pytest.raises(InputError, match=message):
        Arm.from_urdf(TEXT, tip="tool", tool=tool)


Z = torch.tensor([0.0, 0.0, 1.0])
PLACE = transform(position=(0.1, 0, 0))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"offset": PLACE * math.nan}, "the offset of joint 'j' must be finite"),
        ({"offset": torch.eye(3)}, r"the offset of joint 'j' must have shape \(4, 4\)"),
        ({"lower": 1.0, "upper": -1.0}, "joint 'j' has a lower limit of 1.0 and an upper one of -1.0"),
        ({"upper": math.nan}, "joint 'j' has a lower limit of -inf and an upper one of nan"),
        ({"speed_limit": 0.0}, "joint 'j' has a speed limit of 0.0"),
        ({"axis": 0 * Z}, "joint 'j' has no axis"),
        ({"axis": None}, "joint 'j' is revolute, and its axis is None"),
        ({"kind": "fixed"}, "joint 'j' is fixed, and its axis is"),
    ],
)
def test_joints_that_cannot_be_are_refused_however_they_come(fields, message):
    good = {"name": "j", "offset": PLACE, "kind": "revolute", "axis": Z}
    Arm([Joint(**good)])
    with pytest.raises(InputError, match=message):
        Arm([Joint(**{**good, **fields})])


def test_joints_are_coupled_by_hand_too():
    driver = Joint(name="d", offset=PLACE, kind="revolute", axis=Z, lower=-1.0, upper=1.0)
    follower = Joint(offset=PLACE, kind="revolute", axis=Z, coupling=Coupling(driver=driver, ratio=-1.0))
    arm = Arm([driver, follower, Joint(offset=PLACE)], **DOUBLE)
    q = torch.tensor([0.7], **DOUBLE)
    expected = torch.tensor([0.2 + 0.1 * math.cos(0.7) - 0.1, 0.1 * math.sin(0.7)], **DOUBLE) + torch.tensor(
        [0.1, 0], **DOUBLE
    )
    torch.testing.assert_close(arm(q)[:2, 3], expected, atol=1e-12, rtol=0)
    torch.testing.assert_close(arm(q)[:3, :3], torch.eye(3, **DOUBLE), atol=1e-12, rtol=0)


NUMBERS = st.floats(-1.5, 1.5)
ROWS = st.builds(
    Row,
    st.tuples(NUMBERS, NUMBERS, NUMBERS),
    st.tuples(NUMBERS, NUMBERS, NUMBERS),
    st.sampled_from(["revolute", "continuous", "prismatic", "fixed"]),
    st.sampled_from([(0.0, 0.0, 1.0), (1.0, -2.0, 0.5)]),
    lower=st.just(-2.0),
    upper=st.just(2.0),
)


@settings(max_examples=25, deadline=None)
@given(rows=st.lists(ROWS, min_size=1, max_size=5), branch=st.lists(ROWS, min_size=1, max_size=3), at=st.integers(0, 4))
def test_random_trees_are_their_products_of_transforms(rows, branch, at):
    rows = [*rows, Row((0.1, 0.2, 0.3))]
    extra = urdf(branch).replace("joint", "other").replace("<other", "<joint").replace("</other", "</joint")
    for old in ["tool", *(f"link{index}" for index in range(1, 4))]:
        extra = extra.replace(f'"{old}"', f'"b{old}"')
    extra = extra.split('<link name="link0"/>')[1].replace('"link0"', f'"link{min(at, len(rows) - 1)}"')
    arm = Arm.from_urdf(urdf(rows).replace("</robot>", extra), tip="tool", **DOUBLE)
    moved = [row._replace(kind="revolute" if row.kind == "continuous" else row.kind) for row in rows]
    q = configurations(3, arm.num_joints)
    torch.testing.assert_close(arm(q), product_of_transforms(moved, q), atol=1e-9, rtol=0)
