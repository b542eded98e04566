"""What all networks have in common: types of numbers, autocast, empty batches, `torch.vmap`."""

import copy

import pytest
import torch

from tests.nets.kinds import KINDS, histories
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import ESTIMATORS, Forecaster, FunctionArrival
from torchdyn_plan.precision import Precise

HALVES = torch.float16, torch.bfloat16
ROUNDING = {"rtol": 1e-4, "atol": 1e-4}


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return KINDS[request.param]


@pytest.fixture(scope="module")
def network(kind):
    return kind.make().requires_grad_(False)


def convert(tensors, dtype):
    return tuple(value.to(dtype) for value in tensors)


def assert_close(found, expected):
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other.to(one.dtype), **ROUNDING)


def test_float64_goes_in_and_comes_out(kind, network):
    seen = kind.inputs(5)
    found = kind.call(network, convert(seen, torch.float64))
    assert all(value.dtype == torch.float64 for value in found)
    assert_close(found, kind.call(network, seen))


def test_a_network_in_float64_computes_in_it_and_returns_what_it_was_given(kind, network):
    seen, exact = kind.inputs(5), copy.deepcopy(network).double()
    whole = kind.call(exact, convert(seen, torch.float64))
    assert all(value.dtype == torch.float64 for value in whole)
    assert_close(whole, kind.call(network, seen))
    single = kind.call(exact, seen)
    assert all(value.dtype == torch.float32 for value in single)
    for value, other in zip(single, whole, strict=True):
        torch.testing.assert_close(value, other.float(), rtol=2e-6, atol=1e-9)


@pytest.mark.parametrize("dtype", HALVES)
def test_a_network_in_half_precision_keeps_its_constants_and_loses_little(kind, network, dtype):
    seen, stored = kind.inputs(64), copy.deepcopy(network).to(dtype)
    assert all(parameter.dtype == dtype for parameter in stored.parameters())
    for name, value in network.named_buffers():
        assert torch.equal(dict(stored.named_buffers())[name], value), name
    found = kind.call(stored, seen)[0]
    assert found.dtype == torch.float32
    error = (found - kind.call(network, seen)[0]).abs().median()
    assert error <= kind.loss / (8 if dtype == torch.float16 else 1)


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("stored", ["float32", "half"])
def test_half_precision_that_comes_in_is_computed_in_float32(kind, network, dtype, stored):
    network = copy.deepcopy(network).to(dtype) if stored == "half" else network
    seen = convert(kind.inputs(5), dtype)
    found, exact = kind.call(network, seen), kind.call(network, convert(seen, torch.float32))
    assert found[0].dtype in (dtype, torch.float32)
    assert all(torch.equal(one, other.to(one.dtype)) for one, other in zip(found, exact, strict=True))


@pytest.mark.parametrize("dtype", HALVES)
def test_positions_and_scores_have_the_type_of_the_input(dtype):
    for name in ("forecaster", "description", "eta", "actor", "critic", "forecaster for inference"):
        kind = KINDS[name]
        assert kind.call(kind.make().to(dtype), convert(kind.inputs(2), dtype))[0].dtype == dtype, name


@pytest.mark.parametrize("dtype", HALVES)
def test_autocast_changes_nothing(kind, network, dtype):
    seen = kind.inputs(5)
    expected = kind.call(network, seen)
    with torch.autocast("cpu", dtype=dtype):
        found = kind.call(network, seen)
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


def test_autocast_of_another_device_is_no_trouble():
    network, seen = Forecaster.from_pretrained("trapper"), histories(2)[0]
    with pytest.warns(UserWarning, match="not available") if not torch.cuda.is_available() else torch.no_grad():
        autocast = torch.autocast("cuda")
    with autocast, torch.autocast("cpu"):
        assert torch.equal(network(seen), network(seen.clone()))


def test_an_empty_batch_has_empty_results(kind, network):
    found = kind.call(network, kind.inputs(0))
    expected = [(0, *value.shape[1:]) for value in kind.call(network, kind.inputs(1))]
    assert [tuple(value.shape) for value in found] == expected
    nested = kind.call(network, tuple(value.expand(3, *value.shape) for value in kind.inputs(0)))
    assert [tuple(value.shape) for value in nested] == [(3, *shape) for shape in expected]


def test_vmap_is_the_batch(kind, network):
    seen = kind.inputs(6)
    expected = kind.call(network, seen)

    def call(*row):
        return kind.call(network, row)

    assert_close(torch.vmap(call)(*seen), expected)
    blocks = tuple(value.unflatten(0, (2, 3)) for value in seen)
    for mapped in (torch.vmap(call), torch.vmap(torch.vmap(call)), torch.vmap(call, in_dims=1, out_dims=1)):
        assert_close([value.flatten(0, 1) for value in mapped(*blocks)], expected)


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if len(kind.inputs(1)) == 2])
@pytest.mark.parametrize("mapped", [0, 1])
def test_vmap_over_one_of_two_arguments(name, mapped):
    kind = KINDS[name]
    network, seen = kind.make().requires_grad_(False), list(kind.inputs(4))
    seen[1 - mapped] = seen[1 - mapped][:1].expand_as(seen[1 - mapped])
    one = [value if place == mapped else value[0] for place, value in enumerate(seen)]
    dims = tuple(0 if place == mapped else None for place in range(2))
    found = torch.vmap(lambda *row: kind.call(network, row), in_dims=dims)(*one)
    assert_close(found, kind.call(network, tuple(seen)))


ASKED_BY_PLANNERS = ("spread for inference", "arrival from a state for inference", "capture for inference")
"""Forms that planners ask, which have judged what they read already: they look for no NaN again."""


def test_a_nan_is_told_under_vmap_too(kind, network):
    if kind.make.__name__ == "critic":
        pytest.skip("a critic is asked by training alone, and checks nothing")
    if kind in [KINDS[name] for name in ASKED_BY_PLANNERS]:
        pytest.skip("asked by planners, which have looked for it")
    seen = tuple(value.clone() for value in kind.inputs(3))
    seen[0][1] = torch.nan
    with pytest.raises(InputError, match="must be finite"):
        torch.vmap(lambda *row: kind.call(network, row))(*seen)


@pytest.mark.parametrize("name", ASKED_BY_PLANNERS)
def test_a_nan_in_what_a_planner_has_not_judged_stays_in_its_row(name):
    network, seen = KINDS[name].make().requires_grad_(False), tuple(value.clone() for value in KINDS[name].inputs(3))
    expected = KINDS[name].call(network, seen)
    seen[0][1] = torch.nan
    for found, usual in zip(KINDS[name].call(network, seen), expected, strict=True):
        assert found[1].isnan().all()
        assert_close((found[::2],), (usual[::2],))


def test_derivatives_under_transforms(kind, network):
    seen = kind.inputs(3)

    def total(first):
        return kind.call(network, (first, *(value[0] for value in seen[1:])))[0].sum()

    found = torch.vmap(torch.func.grad(total))(seen[0])
    for row, expected in zip(seen[0], found, strict=True):
        leaf = row.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(total(leaf), leaf)
        torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))


def test_whole_numbers_are_refused_by_name(kind, network):
    if kind.make.__name__ == "critic":
        pytest.skip("a critic is asked by training alone, and checks nothing")
    with pytest.raises(InputError, match=r"must hold floating-point numbers, got torch\.int64"):
        kind.call(network, convert(kind.inputs(2), torch.int64))


def test_half_precision_trains():
    network = Forecaster.from_pretrained("trapper").bfloat16()
    network(histories(4)[0]).square().mean().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.dtype == torch.bfloat16
        assert bool(parameter.grad.isfinite().all())


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("dtype", HALVES)
def test_scores_in_half_precision_are_decoded_in_float32(estimator, dtype):
    scores = torch.randn(3, 7, 101, generator=torch.Generator().manual_seed(0)).to(dtype)
    found, exact = ESTIMATORS[estimator](scores), ESTIMATORS[estimator](scores.float())
    assert found.steps.dtype == torch.float32
    assert torch.equal(found.steps, exact.steps)
    assert torch.equal(found.never, exact.never)
    with torch.autocast("cpu", dtype=dtype):
        assert torch.equal(ESTIMATORS[estimator](scores.float()).steps, exact.steps)


def test_a_function_that_answers_in_half_precision_is_widened():
    model = FunctionArrival(lambda state, goal: (goal - state).abs().sum(-1))
    assert model.arrival(torch.ones(2, 1, 3).half(), torch.ones(2, 4, 3).half()).steps.dtype == torch.float32


def test_constants_widen_from_what_they_were():
    module = Precise()
    module.register_buffer("third", torch.tensor(1.0 / 3.0, dtype=torch.float64))
    module.register_buffer("count", torch.tensor(3))
    assert module.half().third.dtype == torch.float32
    assert float(module.third) == float(torch.tensor(1.0 / 3.0))
    assert module.count.dtype == torch.int64
    assert module.double().third.dtype == torch.float64


@pytest.mark.parametrize("name", ["forecaster", "spread for inference", "arrival", "arrival for inference", "actor"])
def test_a_compiled_network_is_one_graph_with_and_without_autocast(name):
    kind = KINDS[name]
    network, seen = kind.make().requires_grad_(False), kind.inputs(3)
    # Each case counts its own graphs.
    torch.compiler.reset()
    compiled = torch.compile(lambda *rows: kind.call(network, rows), backend="eager", fullgraph=True)
    expected = kind.call(network, seen)
    assert_close(compiled(*seen), expected)
    assert compiled(*convert(seen, torch.float64))[0].dtype == torch.float64
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_close(compiled(*seen), expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("dtype", HALVES)
def test_autocast_changes_nothing_on_a_gpu(kind, network, dtype):
    there, seen = copy.deepcopy(network).cuda(), [value.cuda() for value in kind.inputs(5)]
    expected = kind.call(there, seen)
    with torch.autocast("cuda", dtype=dtype):
        found = kind.call(there, seen)
    assert_close(found, expected)
