import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

from tests.kinematics.arms import ARMS, Row, configurations, mjcf, names, product_of_transforms, urdf
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm, Joint
from torchdyn_plan.kinematics.forms import SineForm, TransformForm
from torchdyn_plan.kinematics.joint import transform

DOUBLE = {"dtype": torch.float64}
SIX = ("ur5", "ur5e", "ur10", "panda", "iiwa", "scara", "gantry")


def of_mujoco(rows, q):
    """Poses and Jacobians of the tool by MuJoCo."""
    model = mujoco.MjModel.from_xml_string(mjcf(rows))
    data, site, poses, jacobians = mujoco.MjData(model), model.site("tool").id, [], []
    for values in q.numpy():
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        jacobian = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
        pose = transform(torch.tensor(data.site_xmat[site].reshape(3, 3)), data.site_xpos[site].copy())
        poses.append(pose)
        jacobians.append(torch.from_numpy(jacobian))
    return torch.stack(poses), torch.stack(jacobians)


def of_pinocchio(rows, q):
    """Poses and Jacobians of the tool by pinocchio."""
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromXML(urdf(rows))
    data, frame = model.createData(), model.getFrameId("tool")
    poses, jacobians = [], []
    for values in q.numpy():
        jacobian = pin.computeFrameJacobian(model, data, values, frame, pin.LOCAL_WORLD_ALIGNED)
        poses.append(torch.from_numpy(data.oMf[frame].homogeneous.copy()))
        jacobians.append(torch.from_numpy(jacobian.copy()))
    return torch.stack(poses), torch.stack(jacobians)


@pytest.mark.parametrize("name", SIX)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-5)])
@pytest.mark.parametrize("reference", [of_mujoco, of_pinocchio])
def test_pose_and_jacobian_are_those_of_a_library_in_c(name, dtype, tolerance, reference):
    rows = ARMS[name]
    read, text = (Arm.from_mjcf, mjcf(rows)) if reference is of_mujoco else (Arm.from_urdf, urdf(rows))
    arm = read(text, tip="tool", dtype=dtype)
    q = configurations(100, arm.num_joints, dtype=dtype)
    for value, expected in zip(arm.pose_and_jacobian(q), reference(rows, q.double()), strict=True):
        torch.testing.assert_close(value.double(), expected, atol=tolerance, rtol=0)
    assert (arm(q) - arm.pose_and_jacobian(q)[0]).abs().max() < tolerance


NUMBERS = st.floats(-1.5, 1.5)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)
SHAPES = st.sampled_from([0.0, torch.pi / 2, -torch.pi / 2, torch.pi, 0.3, 1e-7])
TURNS = st.tuples(SHAPES, SHAPES, SHAPES)
AXES = st.one_of(
    st.sampled_from([(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)]),
    VECTORS.filter(lambda axis: sum(x * x for x in axis) > 0.01),
)
KINDS = st.sampled_from(["revolute"] * 4 + ["prismatic", "fixed"])
LIMITS = {"lower": st.floats(-3, -1), "upper": st.floats(1, 3)}
ROWS = st.builds(Row, VECTORS, TURNS, KINDS, AXES, **LIMITS)
MOVING = st.builds(Row, VECTORS, TURNS, st.just("revolute"), AXES, **LIMITS)


@settings(max_examples=40, deadline=None)
@given(rows=st.lists(ROWS, max_size=6), last=MOVING, form=st.sampled_from(["auto", "transforms"]))
def test_random_chains_of_one_to_seven_joints_are_their_products_of_transforms(rows, last, form):
    rows = [*rows, last, Row((0.1, 0.2, 0.3), kind="fixed")]
    arm = Arm.from_urdf(urdf(rows), tip="tool", form=form, **DOUBLE)
    q = configurations(5, arm.num_joints)
    pose, jacobian = arm.pose_and_jacobian(q)
    torch.testing.assert_close(pose, product_of_transforms(rows, q), atol=1e-9, rtol=0)
    torch.testing.assert_close(jacobian, of_mujoco(rows, q)[1], atol=1e-9, rtol=0)
    single = Arm.from_urdf(urdf(rows), tip="tool", form=form)
    for value, expected in zip(single.pose_and_jacobian(q.float()), (pose, jacobian), strict=True):
        torch.testing.assert_close(value.double(), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("name", "kind", "sines"),
    [("ur5", SineForm, 81), ("gantry", SineForm, 9), ("panda", TransformForm, 91), ("scara", TransformForm, 6)],
)
def test_the_form_is_chosen_by_the_size_of_the_expansion(name, kind, sines):
    arm = Arm.from_urdf(urdf(ARMS[name]), tip="tool")
    assert isinstance(arm.form, kind)
    assert len(arm.form._phases) == sines


@pytest.mark.parametrize("name", ["ur5", "panda", "gantry"])
def test_both_forms_can_be_asked_for_and_agree(name):
    text = urdf(ARMS[name])
    sines, product = (Arm.from_urdf(text, tip="tool", form=form, **DOUBLE) for form in ("sines", "transforms"))
    assert isinstance(sines.form, SineForm)
    assert isinstance(product.form, TransformForm)
    q = configurations(20, sines.num_joints)
    for one, other in zip(sines.pose_and_jacobian(q), product.pose_and_jacobian(q), strict=True):
        torch.testing.assert_close(one, other, atol=1e-12, rtol=0)


def test_a_prismatic_joint_behind_a_revolute_one_has_no_sines():
    with pytest.raises(InputError, match="prismatic joint 'joint2' follows a revolute one"):
        Arm.from_urdf(urdf(ARMS["scara"]), tip="tool", form="sines")


def test_an_unknown_form_is_refused():
    with pytest.raises(InputError, match=r"unknown form 'sine' \(did you mean 'sines'"):
        Arm.from_urdf(urdf(ARMS["ur5"]), tip="tool", form="sine")


@pytest.mark.parametrize("base", ["link1", "link3"])
def test_a_base_cuts_the_chain(base):
    rows, start = ARMS["ur5"], names(ARMS["ur5"]).index(base) + 1
    q = configurations(10, 6 - start)
    for read, text in ((Arm.from_urdf, urdf(rows)), (Arm.from_mjcf, mjcf(rows))):
        arm = read(text, tip="tool", base=base, **DOUBLE)
        torch.testing.assert_close(arm(q), product_of_transforms(rows[start:], q), atol=1e-12, rtol=0)


def test_an_anchor_and_a_reference_of_mjcf_are_those_of_mujoco():
    text = (
        '<mujoco><compiler angle="radian"/><worldbody><body name="a" pos="0.1 0.2 0.3" euler="0.3 0.2 0.1">'
        '<joint name="turn" axis="1 2 3" pos="0.05 -0.1 0.2" ref="0.4"/><geom size="1"/>'
        '<body name="b" pos="0.3 0 0"><joint name="slide" type="slide" axis="0 1 1" pos="1 1 1" ref="0.2"/>'
        '<geom size="1"/></body></body></worldbody></mujoco>'
    )
    model = mujoco.MjModel.from_xml_string(text)
    arm, data = Arm.from_mjcf(text, tip="b", **DOUBLE), mujoco.MjData(model)
    for q in configurations(10, 2):
        data.qpos[:] = q.numpy()
        mujoco.mj_kinematics(model, data)
        expected = transform(torch.tensor(data.body("b").xmat.reshape(3, 3)), data.body("b").xpos.copy())
        torch.testing.assert_close(arm(q), expected, atol=1e-12, rtol=0)
    assert arm.joint_names == ("turn", "slide")
    assert arm.upper.tolist() == [float("inf")] * 2


def test_limits_are_the_descriptions():
    rows = [Row((0, 0, 1), lower=-1.0, upper=2.0), Row((0, 0, 1), kind="continuous"), Row((0, 0, 0), kind="fixed")]
    arm = Arm.from_urdf(urdf(rows), tip="tool", **DOUBLE)
    assert (arm.lower.tolist(), arm.upper.tolist()) == ([-1.0, -float("inf")], [2.0, float("inf")])
    assert arm.speed_limit.tolist() == [2.0, 2.0]
    arm = Arm.from_mjcf(mjcf(rows[:1] + rows[2:]), tip="tool", **DOUBLE)
    assert (arm.lower.tolist(), arm.upper.tolist()) == ([-1.0], [2.0])


@pytest.mark.parametrize("form", ["sines", "transforms"])
def test_pose_and_jacobian_have_gradients_in_the_offsets_of_joints(form):
    axis, q = torch.tensor([0.0, 0.0, 1.0], **DOUBLE), torch.tensor([[0.3, -0.4, 0.5]], **DOUBLE)
    turn = transform(
        torch.linalg.matrix_exp(torch.tensor([[0, 0, 0], [0, 0, -1.5707963], [0, 1.5707963, 0]], **DOUBLE))
    )

    def place(offset):
        offsets = [transform(position=(0, 0, 0.3)), turn @ offset, transform(position=(0.4, 0, 0))]
        arm = Arm([Joint(offset=o, kind="revolute", axis=axis) for o in offsets], form=form, **DOUBLE)
        return arm.pose_and_jacobian(q)

    assert gradcheck(place, transform(position=(0.2, 0.0, 0.0)).requires_grad_())
