"""Plans are one graph: traced by the front of `torch.compile` alone, which needs no compiler and little time."""

import pytest
import torch

from tests.planners.first_plan import first_plan
from tests.planners.toy import seen_by
from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import (
    CornerSearch,
    Delayed,
    DynamicPlanner,
    EventSchedule,
    ExactSearch,
    Plan,
    SoftExactSearch,
)
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.task import ik_planner
from torchdyn_plan.tasks.trapper.wait_and_drop import WaitAndDrop, waiting_search

SCENE = TrapperScene()
PARTS = {
    "corner": {"search": CornerSearch()},
    "exact": {"search": ExactSearch()},
    "coarse": {"search": ExactSearch(coarse=4)},
    "soft": {"search": SoftExactSearch()},
    "waiting": {"search": waiting_search(SCENE, by_probability=False), "maneuver": WaitAndDrop.of(SCENE)},
    "late": {"search": ExactSearch(), "delivery": Delayed(5), "schedule": EventSchedule()},
}


@pytest.fixture(scope="module")
def seen():
    return first_plan(3)


def planner(name, *, for_inference=False):
    if name == "as it ships":
        made = load_task("trapper").planner("wait_and_drop", "ik")
    else:
        torch.manual_seed(0)
        networks = Forecaster(square_symmetry=True, half_extent=0.75, hidden=32).eval(), ETANetwork(hidden=32)
        made = DynamicPlanner.paper(ik_planner(), *networks, **PARTS[name]).requires_grad_(False)
    # What is compiled is made by the models themselves: so they are what it is compared with.
    return made.for_inference() if for_inference else made.train()


def asked(made, td):
    """What the planner sees in ``td``, and a plan in use for a meeting in 40 steps."""
    observation = seen_by(made, td)
    plan = Plan.hold(observation, made.memory.path_length)
    return observation, plan._replace(arrival_steps=torch.full_like(plan.arrival_steps, 40))


@pytest.mark.parametrize("for_inference", [False, True])
@pytest.mark.parametrize("name", [*PARTS, "as it ships"])
def test_a_plan_is_one_graph(seen, name, for_inference):
    made = planner(name, for_inference=for_inference)
    observation, plan = asked(made, seen)
    torch._dynamo.reset()
    whole = torch.compile(made.replan, backend="eager", fullgraph=True)(observation, plan)
    for field, one, other in zip(Plan._fields, whole, made.replan(observation, plan), strict=True):
        assert torch.equal(one, other), field


@pytest.mark.parametrize("name", ["corner", "exact", "coarse", "waiting"])
def test_a_planner_for_inference_plans_the_same_and_is_a_copy(seen, name):
    made = planner(name).double()
    td = seen.apply(lambda value: value.double() if value.is_floating_point() else value)
    fast = made.for_inference()
    torch.testing.assert_close(fast.replan(*asked(fast, td)), made.replan(*asked(made, td)))
    assert fast.static is made.static
    assert isinstance(made.forecaster, Forecaster)
    assert not isinstance(fast.forecaster, Forecaster)
    assert fast.in_keys == made.in_keys
