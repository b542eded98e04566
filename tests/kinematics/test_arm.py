import math

import mujoco
import numpy as np
import pytest
import pytorch_kinematics as pk
import torch
from torch.autograd import gradcheck, gradgradcheck

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import UR5_LINKS, UR5_SPEED_LIMIT, Arm, ur5_urdf

SCENE = TrapperScene()
SINGULAR = {
    "stretched": (0.3, -1.0, 0.0, 0.4, 1.0, 0.2),
    "wrist": (0.3, -1.0, 1.2, 0.4, 0.0, 0.2),
    "zero": (0.0,) * 6,
}


@pytest.fixture(scope="module")
def arm():
    return Arm.ur5(tool_length=SCENE.tool_length, dtype=torch.float64)


@pytest.fixture(scope="module")
def model():
    return SCENE.compile()


def configurations(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 6, generator=generator, dtype=torch.float64) * 2 - 1) * 2 * math.pi


def addresses(model, kind):
    return [int(getattr(model.joint(link.joint), kind)[0]) for link in UR5_LINKS]


def test_pose_is_that_of_the_simulated_arm_over_ten_thousand_configurations(arm, model):
    q, data, columns = configurations(10_000), mujoco.MjData(model), addresses(model, "qposadr")
    site, expected = data.site("tool"), torch.zeros(len(q), 3, 4, dtype=torch.float64)
    for joint_pos, pose in zip(q.numpy(), expected.numpy(), strict=True):
        data.qpos[columns] = joint_pos
        mujoco.mj_kinematics(model, data)
        pose[:, :3], pose[:, 3] = site.xmat.reshape(3, 3), site.xpos - SCENE.base_pos
    assert (arm(q)[:, :3] - expected).abs().max() < 1e-6


def test_jacobian_is_that_of_the_simulated_arm(arm, model):
    data, tool, columns = mujoco.MjData(model), model.site("tool").id, addresses(model, "dofadr")
    linear, angular = np.zeros((2, 3, model.nv))
    for q in configurations(200, seed=1):
        data.qpos[addresses(model, "qposadr")] = q.numpy()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, linear, angular, tool)
        expected = np.concatenate([linear[:, columns], angular[:, columns]])
        np.testing.assert_allclose(arm.pose_and_jacobian(q)[1].numpy(), expected, rtol=0, atol=1e-6)


def test_jacobian_is_the_derivative_of_the_pose(arm):
    for q in configurations(20, seed=2):
        pose, jacobian = arm.pose_and_jacobian(q)
        slope = torch.func.jacfwd(arm)(q)
        torch.testing.assert_close(jacobian[:3], slope[:3, 3], atol=1e-12, rtol=0)
        spin = torch.einsum("ijn,kj->nik", slope[:3, :3], pose[:3, :3])
        angular = torch.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]])
        torch.testing.assert_close(jacobian[3:], angular, atol=1e-12, rtol=0)


def test_pose_and_jacobian_are_those_of_pytorch_kinematics(arm):
    tree = pk.build_chain_from_urdf(ur5_urdf(SCENE.tool_length).encode())
    chain = pk.SerialChain(tree, "tool").to(dtype=torch.float64)
    q = configurations(500, seed=3)
    pose, jacobian = arm.pose_and_jacobian(q)
    torch.testing.assert_close(pose, chain.forward_kinematics(q).get_matrix(), atol=1e-6, rtol=0)
    torch.testing.assert_close(jacobian, chain.jacobian(q), atol=1e-6, rtol=0)


@pytest.mark.parametrize("q", SINGULAR.values(), ids=SINGULAR)
def test_gradients_hold_to_second_order_at_singular_configurations(arm, q):
    q = torch.tensor(q, dtype=torch.float64, requires_grad=True)
    assert gradcheck(arm.pose_and_jacobian, q)
    assert gradgradcheck(arm.pose_and_jacobian, q)


def test_bodies_and_chain_come_from_one_table(arm, model):
    assert arm.joint_names == tuple(link.joint for link in UR5_LINKS)
    for index, link in enumerate(UR5_LINKS):
        joint = model.joint(link.joint)
        assert (float(arm.lower[index]), float(arm.upper[index])) == pytest.approx(link.range)
        assert tuple(joint.range) == pytest.approx(link.range)
        assert tuple(model.jnt_actfrcrange[joint.id]) == (-link.torque_limit, link.torque_limit)
        assert tuple(model.actuator(link.joint).forcerange) == (-link.torque_limit, link.torque_limit)
        assert float(model.body(link.name).mass[0]) == link.mass
    assert arm.speed_limit.tolist() == [UR5_SPEED_LIMIT] * 6


def test_the_published_reach_of_a_stretched_ur5():
    place = Arm.ur5(dtype=torch.float64)(torch.zeros(6, dtype=torch.float64))[:3, 3]
    expected = [-0.425 - 0.39225, -0.10915 - 0.0823, 0.089159 - 0.09465]
    torch.testing.assert_close(place, torch.tensor(expected, dtype=torch.float64), atol=1e-7, rtol=0)


@pytest.mark.parametrize("batch", [(), (1,), (7,), (2, 3), (0,)])
def test_batch_dimensions_are_free_and_equal_a_loop(arm, batch):
    q = configurations(math.prod(batch), seed=4).reshape(*batch, 6)
    pose, jacobian = arm.pose_and_jacobian(q)
    assert (pose.shape, jacobian.shape) == ((*batch, 4, 4), (*batch, 6, 6))
    for row, one, other in zip(q.reshape(-1, 6), pose.reshape(-1, 4, 4), jacobian.reshape(-1, 6, 6), strict=True):
        expected = arm.pose_and_jacobian(row)
        torch.testing.assert_close(one, expected[0], atol=1e-13, rtol=0)
        torch.testing.assert_close(other, expected[1], atol=1e-13, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("form", [None, "transforms"])
def test_an_arm_is_made_again_from_its_settings(dtype, form):
    settings = {} if form is None else {"form": form}
    first = Arm.ur5(tool_length=0.084, dtype=dtype)
    first = Arm(**(first.part_settings() | settings))
    again = Arm(**first.part_settings())
    q = configurations(20, seed=6).to(dtype)
    for one, other in zip(again.pose_and_jacobian(q), first.pose_and_jacobian(q), strict=True):
        assert torch.equal(one, other)
    for name in ("lower", "upper", "speed_limit"):
        assert torch.equal(getattr(again, name), getattr(first, name)), name
    assert (again.joint_names, again.joint_kinds) == (first.joint_names, first.joint_kinds)
    assert type(again.form) is type(first.form)


def test_single_precision_is_good_to_a_few_micrometres(arm):
    q = configurations(1000, seed=5)
    pose = Arm.ur5(tool_length=SCENE.tool_length)(q.float())
    assert pose.dtype == torch.float32
    assert (pose.double() - arm(q)).abs().max() < 1e-5


@pytest.mark.parametrize("shape", [(5,), (3, 7), (6, 1), ()])
def test_a_wrong_shape_is_named(arm, shape):
    with pytest.raises(InputError, match=rf"joint_pos must have shape \(\*B, 6\), got \({', '.join(map(str, shape))}"):
        arm(torch.zeros(shape, dtype=torch.float64))


def urdf(kind, limit='<limit lower="-1" upper="1" effort="1" velocity="1"/>'):
    return (
        f'<robot name="r"><link name="a"/><link name="b"/><joint name="slide" type="{kind}">'
        f'<parent link="a"/><child link="b"/><axis xyz="0 0 1"/>{limit}</joint></robot>'
    )


def test_a_chain_without_a_joint_that_moves_is_refused():
    with pytest.raises(InputError, match="no joint that moves"):
        Arm.from_urdf(urdf("fixed"), tip="b")


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_a_joint_of_another_kind_is_refused(kind):
    with pytest.raises(InputError, match=f"has a joint of type '{kind}'; Arm handles fixed, revolute and prismatic"):
        Arm.from_urdf(urdf(kind), tip="b")


def test_a_ball_joint_of_mjcf_is_refused():
    text = '<mujoco><worldbody><body name="b"><joint type="ball"/><geom size="1"/></body></worldbody></mujoco>'
    with pytest.raises(InputError, match=r"the MJCF text has a joint of type .*; Arm handles fixed, revolute"):
        Arm.from_mjcf(text, tip="b")


@pytest.mark.parametrize(
    ("read", "text"), [(Arm.from_urdf, "<robot"), (Arm.from_mjcf, "<mujoco>"), (Arm.from_urdf, "")]
)
def test_text_that_is_no_description_is_refused(read, text):
    with pytest.raises(InputError, match="text cannot be read"):
        read(text, tip="b")


def test_another_precision_and_another_device_are_named(arm):
    with pytest.raises(InputError, match=r"joint_pos is torch.float32, but the arm is torch.float64"):
        arm(torch.zeros(6))
    with pytest.raises(InputError, match="joint_pos is on meta, but the arm is on cpu"):
        arm(torch.zeros(6, device="meta", dtype=torch.float64))


def test_an_unknown_tip_is_refused_with_the_choices():
    with pytest.raises(InputError, match=r"unknown link 'too' \(did you mean 'tool'"):
        Arm.from_urdf(ur5_urdf(), tip="too")


def test_an_unknown_base_and_one_beyond_the_tip_are_refused():
    with pytest.raises(InputError, match=r"unknown link 'bas' \(did you mean 'base'"):
        Arm.from_urdf(ur5_urdf(), tip="tool", base="bas")
    with pytest.raises(InputError, match="link 'forearm' does not hang from link 'tool'"):
        Arm.from_urdf(ur5_urdf(), tip="forearm", base="tool")


def test_any_axis_and_offset_equals_pytorch_kinematics():
    text = (
        '<robot name="r"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>'
        '<joint name="j" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.5 '
        '0.6"/><axis xyz="0.48 0.6 0.64"/><limit lower="-1" upper="1" effort="1" velocity="2"/></joint>'
        '<joint name="k" type="revolute"><parent link="b"/><child link="c"/><origin xyz="-0.3 0.2 0.1" rpy="1 2 3"/>'
        '<axis xyz="0 -1 0"/><limit lower="-2" upper="3" effort="1" velocity="4"/></joint>'
        '<joint name="l" type="fixed"><parent link="c"/><child link="d"/><origin xyz="0.5 0 0" rpy="0 1 0"/></joint>'
        "</robot>"
    )
    arm = Arm.from_urdf(text, tip="d", dtype=torch.float64)
    chain = pk.SerialChain(pk.build_chain_from_urdf(text.encode()), "d").to(dtype=torch.float64)
    q = configurations(50, seed=6)[:, :2]
    pose, jacobian = arm.pose_and_jacobian(q)
    torch.testing.assert_close(pose, chain.forward_kinematics(q).get_matrix(), atol=1e-6, rtol=0)
    torch.testing.assert_close(jacobian, chain.jacobian(q), atol=1e-6, rtol=0)
    assert arm.speed_limit.tolist() == [2.0, 4.0]
    assert (arm.lower.tolist(), arm.upper.tolist()) == ([-1.0, -2.0], [1.0, 3.0])
