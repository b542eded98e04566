"""A planner that is not to be trained plans by copies of its models for inference, and only where that is the same."""

import copy

import cloudpickle
import pytest
import torch
from torch.func import functional_call

from tests.planners.first_plan import first_plan
from torchdyn_plan.planners import DynamicPlanner, Observation, Plan, observe
from torchdyn_plan.planners.pretrained import planner_digest


@pytest.fixture(scope="module")
def seen():
    td = first_plan(4)
    return lambda planner: observe(td, planner.forecaster)


@pytest.fixture
def planner():
    return DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop")


def path_of(planner, observation):
    """The path by which it plans: its last bits tell which networks made it."""
    return planner.replan(observation, Plan.hold(observation, 0)).path


def by_models(planner, observation):
    path = path_of(planner, observation)
    trained = planner.forecaster.predict(*observation.seen).path
    whole = torch.cat([observation.target_pos.unsqueeze(-2), trained], -2)[:, : path.shape[-2]]
    torch.testing.assert_close(path, whole, atol=2e-4, rtol=0.0)
    return torch.equal(path, whole)


def test_a_loaded_planner_plans_by_copies_of_its_models(planner, seen):
    observation = seen(planner)
    assert not by_models(planner, observation)
    one, other = (made.replan(observation, Plan.hold(observation, 0)) for made in (planner, planner.for_inference()))
    assert all(map(torch.equal, one, other))


def test_in_training_mode_it_plans_by_the_models_themselves(planner, seen):
    assert by_models(planner.train(), seen(planner))
    assert not by_models(planner.eval(), seen(planner))


CHANGES = {
    "trained on": lambda planner: planner.forecaster.requires_grad_(True),
    "a network's head is trained": lambda planner: planner.eta.head.requires_grad_(True),
    "changed in place": lambda planner: planner.forecaster.exact.forecaster.head.bias.add_(1e-3),
    "loaded": lambda planner: planner.load_state_dict(planner.state_dict()),
    "a network loaded": lambda planner: planner.eta.load_state_dict(planner.eta.state_dict()),
    "exchanged": lambda planner: setattr(planner.eta.head, "bias", torch.nn.Parameter(planner.eta.head.bias.data)),
    "taken away": lambda planner: setattr(planner.eta.head, "bias", None),
    "other statistics": lambda planner: planner.eta.set_input_statistics(torch.randn(9, 15), torch.randn(9, 3)),
    "shared with other processes": lambda planner: planner.share_memory(),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_copies_of_other_weights_are_not_asked(planner, seen, change):
    with torch.no_grad():
        change(planner)
        assert by_models(planner, seen(planner))


@pytest.mark.parametrize("name", ["changed in place", "loaded", "other statistics"])
def test_eval_prepares_the_models_as_they_are_now(planner, seen, name):
    with torch.no_grad():
        CHANGES[name](planner)
    assert not by_models(planner.eval(), seen(planner))


@pytest.mark.parametrize("make", [copy.deepcopy, lambda planner: cloudpickle.loads(cloudpickle.dumps(planner))])
def test_a_copy_of_a_planner_has_copies_of_its_own_models(planner, seen, make):
    made = make(planner)
    assert torch.equal(path_of(made, seen(made)), path_of(planner, seen(planner)))
    assert not by_models(made, seen(made))
    with torch.no_grad():
        made.forecaster.exact.forecaster.head.bias.add_(1.0)
    assert not torch.equal(path_of(made, seen(made)), path_of(planner, seen(planner)))
    assert not by_models(planner, seen(planner))


def test_it_moves_and_converts_with_the_planner(planner, seen):
    observation = Observation.of([value.double() for value in seen(planner).flat()])
    found = path_of(planner.double(), observation)
    exact = path_of(planner.train(), observation)
    torch.testing.assert_close(found, exact, atol=1e-10, rtol=0.0)
    assert not torch.equal(found, exact)


def test_derivatives_are_those_of_the_models(planner, seen):
    for made in (planner, copy.deepcopy(planner).train()):
        observation = seen(made)
        history = observation.seen[0].clone().requires_grad_()
        path_of(made, observation._replace(seen=(history,)))[:, -1].sum().backward()
        assert history.grad.abs().sum() > 0.0
        gradient = history.grad
        if made is planner:
            expected = gradient
    assert torch.equal(gradient, expected)


def test_weights_that_are_exchanged_for_a_call_are_heeded(planner, seen):
    observation = seen(planner)
    name = "forecaster.exact.forecaster.head.bias"
    moved = {name: dict(planner.named_parameters())[name] + 1.0}

    class Replan(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.planner = planner

        def forward(self):
            return path_of(self.planner, observation)

    found = functional_call(Replan(), {f"planner.{key}": value for key, value in moved.items()})
    assert (found - path_of(planner, observation)).abs().max() > 1e-3


def test_transforms_and_compilers_see_the_models(planner, seen):
    observation = seen(planner)
    trained = path_of(copy.deepcopy(planner).train(), observation)

    def replan(*tensors):
        return path_of(planner, Observation.of(tensors))

    rows = [value.unsqueeze(1) for value in observation.flat()]
    mapped = torch.vmap(replan)(*rows).squeeze(1)
    compiled = torch.compile(replan, backend="eager", fullgraph=True)(*observation.flat())
    assert torch.equal(compiled, trained)
    torch.testing.assert_close(mapped, trained, atol=2e-4, rtol=0.0)


def test_what_is_saved_and_told_of_a_planner_does_not_depend_on_it(planner, tmp_path):
    digest, names = planner_digest(planner), list(planner.state_dict())
    planner.save_pretrained(tmp_path / "eval")
    planner.train().save_pretrained(tmp_path / "train")
    assert planner_digest(planner) == digest
    assert list(planner.state_dict()) == names
    one, other = (tmp_path / name / "planner.json" for name in ("eval", "train"))
    assert one.read_text() == other.read_text()


def test_own_functions_are_asked_as_they_are(planner):
    own = {"forecaster": lambda history: history, "eta": lambda state, goal: goal[..., 0], "capture": None}
    made = planner.with_parts(**own)
    assert made.eval().prepared is None
