"""Arms out of MJCF scenes as people have them, against MuJoCo itself."""

import math
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.envs.fetch_reach.simulation import fetch_model_path
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm

GEOM = '<geom size="0.01"/>'
ARM = (
    f'<body name="a" pos="0 0 .3"><joint name="j1" range="-2 2"/>{GEOM}'
    f'<body name="b" pos=".3 0 0" euler=".2 .3 .4"><joint name="j2" axis="0 1 0" range="-1 2"/>{GEOM}'
    f'<body name="tip" pos=".2 0 0">{GEOM}<site name="tool" pos=".1 0 0"/></body></body></body>'
)


def scene(bodies, more=""):
    return f'<mujoco><compiler angle="radian"/><worldbody>{bodies}</worldbody>{more}</mujoco>'


def reference(model, data, kind, index, base=0):
    """Pose and Jacobian of a body or site in the frame of the body ``base``, by MuJoCo."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    linear, angular = np.zeros((2, 3, model.nv))
    (mujoco.mj_jacSite if kind == "site" else mujoco.mj_jacBody)(model, data, linear, angular, index)
    names = ("site_xmat", "site_xpos") if kind == "site" else ("xmat", "xpos")
    pose, start = np.eye(4), np.eye(4)
    pose[:3, :3], pose[:3, 3] = getattr(data, names[0])[index].reshape(3, 3), getattr(data, names[1])[index]
    start[:3, :3], start[:3, 3] = data.xmat[base].reshape(3, 3), data.xpos[base]
    turn = np.kron(np.eye(2), start[:3, :3].T)
    return np.linalg.inv(start) @ pose, turn @ np.concatenate([linear, angular])


def assert_is_mujocos(arm, model, kind, index, joints, base=0):
    """``joints`` are the indices of the arm's own in the model."""
    generator, data = np.random.default_rng(0), mujoco.MjData(model)
    assert arm.num_joints == len(joints)
    for _ in range(5):
        q = generator.uniform(-1, 1, len(joints))
        data.qpos[model.jnt_qposadr[joints]] = q
        pose, jacobian = arm.pose_and_jacobian(torch.tensor(q))
        expected = reference(model, data, kind, index, base)
        np.testing.assert_allclose(pose, expected[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(jacobian, expected[1][:, model.jnt_dofadr[joints]], rtol=0, atol=1e-9)


CARTS = (
    '<body name="cart"><joint name="cx" type="slide" axis="1 0 0"/><joint name="cy" type="slide" axis="0 1 0"/>'
    f'<joint name="turn" axis="0 0 1" pos=".1 .2 0" ref=".3"/>{GEOM}{{}}</body>'
)
UNNAMED = (
    f'<body pos="0 0 .3"><joint name="j1"/>{GEOM}<body pos=".3 0 .1" euler=".2 .3 .4"><joint name="j2" axis="0 1 0"/>'
    f'{GEOM}<body name="tip" pos=".2 0 0">{GEOM}</body></body></body>'
)
KINDS_OF_SCENE = {
    "a free ball": (scene(ARM + f'<body name="ball"><freejoint/>{GEOM}</body>'), "body", "tip", [0, 1]),
    "a ball joint elsewhere": (scene(f'<body><joint type="ball"/>{GEOM}</body>' + ARM), "body", "tip", [1, 2]),
    "two joints on a body elsewhere": (scene(CARTS.format("") + ARM), "site", "tool", [3, 4]),
    "three joints on one body": (scene(CARTS.format(ARM)), "body", "tip", [0, 1, 2, 3, 4]),
    "two unnamed bodies": (scene(UNNAMED), "body", "tip", [0, 1]),
    "unnamed bodies here and elsewhere": (
        scene(f'<body pos="3 3 3">{GEOM}</body>' + ARM.replace('name="b" ', "")),
        "body",
        "tip",
        [0, 1],
    ),
    "unnamed joints": (scene(ARM.replace('name="j1" ', "").replace('name="j2" ', "")), "body", "tip", [0, 1]),
    "a site named as another body": (scene(ARM.replace('name="tool"', 'name="b"')), "site", "b", [0, 1]),
    "a site named as its body": (scene(ARM.replace('name="tool"', 'name="tip"')), "site", "tip", [0, 1]),
    "two roots": (scene(ARM.replace('name="', 'name="left_') + ARM), "body", "tip", [2, 3]),
    "a mocap body": (scene(f'<body name="m" mocap="true" pos="1 0 0">{GEOM}</body>' + ARM), "site", "tool", [0, 1]),
}


@pytest.mark.parametrize(("text", "kind", "tip", "joints"), KINDS_OF_SCENE.values(), ids=KINDS_OF_SCENE)
def test_the_arm_is_read_out_of_a_scene_with_anything_in_it(text, kind, tip, joints):
    model = mujoco.MjModel.from_xml_string(text)
    arm = Arm.from_mjcf(text, tip=tip, dtype=torch.float64)
    assert_is_mujocos(arm, model, kind, getattr(model, kind)(tip).id, joints)
    assert arm.joint_names == tuple(model.joint(index).name or f"joint#{index}" for index in joints)


def test_body_and_site_of_one_name_can_be_told_apart():
    text = scene(ARM.replace('name="tool"', 'name="b"'))
    model = mujoco.MjModel.from_xml_string(text)
    for tip, kind in {"b": "site", "site:b": "site", "body:b": "body"}.items():
        arm = Arm.from_mjcf(text, tip=tip, dtype=torch.float64)
        assert_is_mujocos(arm, model, kind, getattr(model, kind)("b").id, [0, 1])


def test_what_has_no_name_is_told_by_its_index():
    text = scene(UNNAMED)
    arm = Arm.from_mjcf(text, tip="body#2", base="body#1", dtype=torch.float64)
    assert_is_mujocos(arm, mujoco.MjModel.from_xml_string(text), "body", 2, [1], base=1)


def test_an_index_never_takes_a_name_that_something_else_bears():
    text = scene(ARM.replace('name="j1" ', "").replace('name="j2"', 'name="joint#0"'))
    names = Arm.from_mjcf(text, tip="tip").joint_names
    assert len(set(names)) == 2
    assert names[1] == "joint#0"


NUMBERS = st.floats(-1, 1)
PLACES = st.builds("{:.3f} {:.3f} {:.3f}".format, NUMBERS, NUMBERS, NUMBERS)
AXES = st.sampled_from(["1 0 0", "0 1 0", "0 0 1", "1 2 3", "-1 0.5 0"])
JOINTS = st.builds(
    '<joint type="{}" axis="{}" pos="{}" ref="{:.3f}"/>'.format,
    st.sampled_from(["hinge", "hinge", "slide"]),
    AXES,
    PLACES,
    NUMBERS,
)


@st.composite
def trees(draw, depth=3):
    name = draw(st.sampled_from(["", "", 'name="x"']))
    joints = "".join(draw(st.lists(JOINTS, max_size=2)))
    sites = "".join(f'<site pos="{place}"/>' for place in draw(st.lists(PLACES, max_size=1)))
    below = "".join(draw(st.lists(trees(depth=depth - 1), max_size=2))) if depth else ""
    body = f'<body pos="{draw(PLACES)}" euler="{draw(PLACES)}" {{}}>{joints}{GEOM}{sites}{below}</body>'
    return body.format(name if depth == 3 else "")


@settings(max_examples=25, deadline=None)
@given(st.lists(trees(), min_size=1, max_size=2, unique_by=lambda tree: 'name="x"' in tree), st.randoms())
def test_random_trees_without_names_are_mujocos(bodies, random):
    text = scene("".join(bodies) + f"<body><freejoint/>{GEOM}</body>")
    model = mujoco.MjModel.from_xml_string(text)
    index = random.randrange(1, model.nbody - 1)
    joints, body = [], index
    while body:
        joints = [*range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]), *joints]
        body = int(model.body_parentid[body])
    tip = model.body(index).name or f"body#{index}"
    if joints:
        assert_is_mujocos(Arm.from_mjcf(model, tip=tip, dtype=torch.float64), model, "body", index, joints)
    else:
        with pytest.raises(InputError, match="no joint that moves"):
            Arm.from_mjcf(model, tip=tip)


def test_trappers_own_scene_is_read_as_it_is():
    model = TrapperScene().compile()
    arm = Arm.from_mjcf(model, tip="tool", dtype=torch.float64)
    assert_is_mujocos(arm, model, "site", model.site("tool").id, [model.joint(name).id for name in arm.joint_names])
    assert arm.joint_names == Arm.ur5().joint_names


def test_the_fetch_model_is_read_as_it_is():
    pytest.importorskip("gymnasium_robotics")
    model = mujoco.MjModel.from_xml_path(str(fetch_model_path()))
    arm = Arm.from_mjcf(fetch_model_path(), tip="robot0:grip", dtype=torch.float64)
    joints = [model.joint(name).id for name in arm.joint_names]
    assert_is_mujocos(arm, model, "site", model.site("robot0:grip").id, joints)
    shoulder = model.body("robot0:torso_lift_link").id
    arm = Arm.from_mjcf(model, tip="robot0:grip", base="robot0:torso_lift_link", dtype=torch.float64)
    assert_is_mujocos(arm, model, "site", model.site("robot0:grip").id, joints[-7:], base=shoulder)


@pytest.fixture
def folder(tmp_path):
    """A scene in several files."""
    lines = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "cube.obj").write_text(lines + "f 1 2 3\nf 2 3 4\nf 5 6 7\nf 6 7 8\n")
    (tmp_path / "arm.xml").write_text(f"<mujocoinclude>{ARM}</mujocoinclude>")
    mesh = '<asset><mesh name="cube" file="parts/cube.obj"/></asset>'
    text = scene('<include file="arm.xml"/><geom type="mesh" mesh="cube"/>', mesh)
    (tmp_path / "scene.xml").write_text(text)
    return tmp_path


def test_meshes_and_included_files_are_found_beside_the_description(folder):
    file = folder / "scene.xml"
    model, here = mujoco.MjModel.from_xml_path(str(file)), Path.cwd()
    expected = Arm.from_mjcf(model, tip="tool")
    q = torch.tensor([0.3, -0.2])
    for source in (file, str(file), mujoco.MjSpec.from_file(str(file))):
        assert torch.equal(Arm.from_mjcf(source, tip="tool")(q), expected(q))
    assert Path.cwd() == here
    with pytest.raises(InputError, match=r"opening file 'arm.xml'.*files are searched for in the description.s folder"):
        Arm.from_mjcf(file.read_text(), tip="tool")


def test_text_may_be_bytes():
    q = torch.tensor([0.3, -0.2])
    assert torch.equal(Arm.from_mjcf(scene(ARM).encode(), tip="tip")(q), Arm.from_mjcf(scene(ARM), tip="tip")(q))


FREE = scene(f'<body name="torso"><freejoint name="root"/>{GEOM}{ARM}</body>')


@pytest.mark.parametrize(
    ("source", "places", "message"),
    [
        (FREE, {"tip": "tip"}, r"joint of type 'free'.*'root' of the body 'torso'.*choose this body"),
        (scene(ARM), {"tip": "tp"}, r"unknown body or site 'tp' \(did you mean 'tip'"),
        (scene(ARM), {"tip": "site:tip"}, r"unknown site 'tip'.*choose from tool"),
        (scene(ARM), {"tip": "tip", "base": "tool"}, r"unknown body 'tool'"),
        (scene(ARM), {"tip": "a", "base": "tip"}, "'a' does not hang from body 'tip'"),
        (scene(ARM), {"tip": "world"}, "no joint that moves"),
        ("nowhere.xml", {"tip": "tip"}, "'nowhere.xml' is neither a description nor a file"),
        ({"a": 1}, {"tip": "tip"}, "MJCF comes as text or as a path, got dict"),
    ],
)
def test_what_cannot_be_read_is_named(source, places, message):
    with pytest.raises(InputError, match=message):
        Arm.from_mjcf(source, **places)


def test_behind_a_free_joint_the_arm_is_read():
    model = mujoco.MjModel.from_xml_string(FREE)
    assert_is_mujocos(Arm.from_mjcf(FREE, tip="tool", base="torso", dtype=torch.float64), model, "site", 0, [1, 2], 1)


def test_without_mujoco_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"mujoco, which is not installed: pip install 'torchdyn-plan\[sim\]'"):
        Arm.from_mjcf(scene(ARM), tip="tip")


JOINT = '<equality><joint joint1="j2" joint2="j1" polycoef="{}"/></equality>'
TENDON = (
    '<tendon><fixed name="t"><joint joint="j1" coef="2"/><joint joint="j2" coef="-.5"/></fixed></tendon>'
    '<equality><tendon tendon1="t" polycoef=".1 0 0 0 0"/></equality>'
)
TENDONS = (
    '<tendon><fixed name="t"><joint joint="j1" coef="2"/></fixed><fixed name="u"><joint joint="j2" coef="3"/></fixed>'
    '</tendon><equality><tendon tendon1="t" tendon2="u" polycoef=".1 .5 0 0 0"/></equality>'
)
REFS = ARM.replace('name="j1"', 'name="j1" ref=".2"').replace('name="j2"', 'name="j2" ref="-.4"')


@pytest.mark.parametrize("bodies", [ARM, REFS], ids=["", "refs"])
@pytest.mark.parametrize("more", [JOINT.format(".3 -2 0 0 0"), TENDON, TENDONS], ids=["joint", "tendon", "two tendons"])
def test_joints_that_an_equality_couples_are_one(bodies, more):
    text = scene(bodies, more)
    arm, model = Arm.from_mjcf(text, tip="tool", dtype=torch.float64), mujoco.MjModel.from_xml_string(text)
    assert arm.joint_names == ("j1",)
    data, joints = mujoco.MjData(model), list(Arm.from_mjcf(scene(bodies), tip="tool").joint_names)
    assert joints == ["j1", "j2"]
    for q in torch.linspace(-0.4, 0.4, 5, dtype=torch.float64):
        data.qpos[0] = float(q)
        for _ in range(2):
            mujoco.mj_fwdPosition(model, data)
            slope = data.efc_J.reshape(-1, model.nv)[0]
            data.qpos[1] -= data.efc_pos[0] / slope[1]
        pose, jacobian = arm.pose_and_jacobian(q[None])
        expected = reference(model, data, "site", 0)
        np.testing.assert_allclose(pose, expected[0], rtol=0, atol=1e-9)
        motion = np.array([[1.0], [-slope[0] / slope[1]]])
        np.testing.assert_allclose(jacobian, expected[1] @ motion, rtol=0, atol=1e-9)


def test_limits_of_coupled_joints_hold_for_both():
    arm = Arm.from_mjcf(scene(ARM, JOINT.format("0.5 -2 0 0 0")), tip="tip", dtype=torch.float64)
    # -1 <= 0.5 - 2 q <= 2, which is narrower than j1's own ±2.
    assert (arm.lower.tolist(), arm.upper.tolist()) == ([-0.75], [0.75])


def test_an_equality_that_is_off_or_elsewhere_does_not_matter():
    off = JOINT.format("0 2 0 0 0").replace("<joint ", '<joint active="false" ')
    other = CARTS.format("") + ARM
    coupled = '<equality><joint joint1="cx" joint2="cy"/><weld body1="cart" body2="tip"/></equality>'
    for text in (scene(ARM, off), scene(other, coupled)):
        assert Arm.from_mjcf(text, tip="tip").joint_names == ("j1", "j2")


def test_a_joint_that_is_held_by_an_equality_is_fixed():
    text = scene(REFS, '<equality><joint joint1="j1" polycoef=".3 0 0 0 0"/></equality>')
    model, arm = mujoco.MjModel.from_xml_string(text), Arm.from_mjcf(text, tip="tool", dtype=torch.float64)
    assert arm.joint_names == ("j2",)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.2 + 0.3, 0.7
    expected = reference(model, data, "site", 0)
    np.testing.assert_allclose(arm(torch.tensor([0.7], dtype=torch.float64)), expected[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (JOINT.format("0 1 2 0 0"), "joint 'j2' is coupled to others: by a polynomial"),
        (JOINT.format("9 1 0 0 0"), "joint 'j1' moves joint 'j2', and their limits leave no position"),
        (
            '<equality><joint joint1="j2" joint2="j1"/><joint joint1="j1" joint2="j2"/></equality>',
            "the joints 'j2', 'j1' are coupled in a circle",
        ),
        (
            '<equality><joint joint1="j2" joint2="j1"/><joint joint1="j2" joint2="j1"/></equality>',
            "joint 'j2' is coupled to others: by more than one equality",
        ),
        (
            '<tendon><spatial name="t"><site site="tool"/><site site="rest"/></spatial></tendon>'
            '<equality><tendon tendon1="t"/></equality>',
            "joint 'j2' is coupled to others: by the tendon 't'",
        ),
    ],
)
def test_couplings_that_cannot_be_had_are_refused_by_name(more, message):
    with pytest.raises(InputError, match=message):
        Arm.from_mjcf(scene(ARM + '<site name="rest" pos="1 1 1"/>', more), tip="tip")


def test_reading_prints_nothing(capfd, folder):
    Arm.from_mjcf(folder / "scene.xml", tip="tool")
    with pytest.raises(InputError):
        Arm.from_mjcf("<mujoco><wrong/></mujoco>", tip="tool")
    assert capfd.readouterr() == ("", "")


def test_mjcf_knows_no_speed_limits_and_one_error_asks_for_them():
    arm = Arm.from_mjcf(scene(ARM), tip="tip")
    with pytest.raises(InputError, match=r"IKPlanner needs the speed limits .* none for 'j1', 'j2': .*speed_limit="):
        arm.needed_speed_limit("IKPlanner")
    for speeds, expected in ((2.0, [2.0, 2.0]), ([1.0, 3.0], [1.0, 3.0])):
        limited = Arm.from_mjcf(scene(ARM), tip="tip", speed_limit=speeds)
        assert limited.needed_speed_limit("IKPlanner").tolist() == expected
        assert Arm(**limited.part_settings()).speed_limit.tolist() == expected


@pytest.mark.parametrize("given", [0.0, -1.0, math.nan, [1.0], [1.0, 0.0], [1.0, 2.0, 3.0]])
def test_a_speed_limit_that_cannot_be_is_refused(given):
    with pytest.raises(InputError, match=r"speed.limit"):
        Arm.from_mjcf(scene(ARM), tip="tip", speed_limit=given)
