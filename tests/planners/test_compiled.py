"""Plans are one graph: traced by the front of `torch.compile` alone, which needs no compiler and little time."""

from functools import partial

import pytest
import torch

from torchdyn_plan.evaluation.bench_replan import observations
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import CornerSearch, DynamicPlanner, ExactSearch, IKPlanner, MeetingPlanner, SoftExactSearch


def planner(kind, search, *, folded):
    if search == "as it ships":
        made = kind.from_pretrained("trapper-ik")
        return made.folded() if folded else made
    torch.manual_seed(0)
    parts = IKPlanner(), Forecaster(square_symmetry=True, half_extent=0.75, hidden=32).eval(), ETANetwork(hidden=32)
    made = kind(*parts, search=search).requires_grad_(False)
    return made.folded() if folded else made


PLANNERS = [
    (DynamicPlanner, CornerSearch()),
    (DynamicPlanner, ExactSearch()),
    (DynamicPlanner, ExactSearch(coarse=4)),
    (DynamicPlanner, SoftExactSearch()),
    (MeetingPlanner, None),
    (MeetingPlanner, "as it ships"),
]


@pytest.mark.parametrize("folded", [False, True])
@pytest.mark.parametrize(("kind", "search"), PLANNERS)
def test_a_plan_is_one_graph(kind, search, folded):
    made, seen = planner(kind, search, folded=folded), observations(3)
    inputs = [seen["robot_state"], seen["target_pos"], seen["target_history"]]
    plan = made.plan
    if kind is MeetingPlanner:
        plan = partial(made.plan_ahead)
        inputs[2:2] = [seen["tool_pos"], torch.full((3,), 40)]
    torch._dynamo.reset()
    whole = torch.compile(plan, backend="eager", fullgraph=True)(*inputs)
    for one, other in zip(whole, plan(*inputs), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("search", [CornerSearch(), ExactSearch(), ExactSearch(coarse=4)])
def test_a_folded_planner_plans_the_same_and_is_a_copy(search):
    made, seen = planner(DynamicPlanner, search, folded=False).double(), observations(64)
    inputs = [seen[key].double() for key in ("robot_state", "target_pos", "target_history")]
    folded = made.folded()
    torch.testing.assert_close(folded.plan(*inputs), made.plan(*inputs))
    assert folded.static is made.static
    assert isinstance(made.forecaster, Forecaster)
    assert not isinstance(folded.forecaster, Forecaster)
    assert folded.in_keys == made.in_keys
