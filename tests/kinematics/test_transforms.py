import pytest
import torch

from tests.kinematics.arms import ARMS, configurations, urdf
from torchdyn_plan.kinematics import Arm

FORMS = {"ur5": "sines", "panda": "transforms", "scara": "transforms"}


@pytest.fixture(scope="module", params=FORMS)
def arm(request):
    return Arm.from_urdf(urdf(ARMS[request.param]), tip="tool", dtype=torch.float64)


def test_vmap_equals_a_batch(arm):
    q = configurations(6, arm.num_joints).view(2, 3, -1)
    rows = torch.func.vmap(torch.func.vmap(arm.pose_and_jacobian))(q)
    for one, other in zip(rows, arm.pose_and_jacobian(q), strict=True):
        torch.testing.assert_close(one, other, atol=1e-13, rtol=0)


def test_forward_and_reverse_derivatives_are_the_jacobian(arm):
    q = configurations(4, arm.num_joints)
    jacobian = arm.pose_and_jacobian(q)[1]
    for derivative in (torch.func.jacfwd, torch.func.jacrev):
        slope = torch.func.vmap(derivative(lambda values: arm(values)[:3, 3]))(q)
        torch.testing.assert_close(slope, jacobian[:, :3], atol=1e-12, rtol=0)


def test_second_derivatives_of_both_kinds_agree(arm):
    q = configurations(1, arm.num_joints)[0]
    forward = torch.func.jacfwd(torch.func.jacfwd(arm))(q)
    torch.testing.assert_close(torch.func.jacrev(torch.func.jacrev(arm))(q), forward, atol=1e-12, rtol=0)
    assert torch.autograd.gradgradcheck(arm.pose_and_jacobian, q.requires_grad_())


@pytest.mark.filterwarnings("ignore")
def test_it_compiles_as_one_graph(arm):
    q = configurations(4, arm.num_joints)
    compiled = torch.compile(arm.pose_and_jacobian, fullgraph=True, backend="aot_eager")
    for one, other in zip(compiled(q), arm.pose_and_jacobian(q), strict=True):
        torch.testing.assert_close(one, other, atol=1e-13, rtol=0)


@pytest.mark.filterwarnings("ignore")
def test_it_is_exported_with_a_free_batch(arm):
    shapes = ({0: torch.export.Dim("batch", min=2)},)
    program = torch.export.export(arm, (configurations(4, arm.num_joints),), dynamic_shapes=shapes)
    q = configurations(7, arm.num_joints)
    torch.testing.assert_close(program.module()(q), arm(q), atol=1e-13, rtol=0)
