import copy

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import CaptureNetwork, ETANetwork, Forecaster, SpreadForecaster, SpreadNetwork, inference
from torchdyn_plan.nets.symmetry import square_symmetries

FORECASTERS = [
    {"square_symmetry": True, "half_extent": 0.7},
    {"square_symmetry": False, "half_extent": 0.7},
    {"square_symmetry": True},
    {"channels": 40, "convolutions": 2},
    {"history": 12, "convolutions": 4},
    {"history": 6},
    {"history": 6, "gravity": (0.1, 0.0, -9.81), "drag": 0.05, "control_step": 0.008},
]


def forecaster(**settings):
    torch.manual_seed(0)
    network = Forecaster(**{"horizon": 20, "hidden": 16, "channels": 8, **settings}).double()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return network.eval().requires_grad_(False)


def arrivals():
    torch.manual_seed(0)
    network = ETANetwork(hidden=16).double().eval().requires_grad_(False)
    state, goal, _ = samples(300)
    network.set_input_statistics(3 * state + 1, 2 * goal - 1)
    return network


def samples(*batch):
    draw = torch.Generator().manual_seed(0)
    return [torch.rand(*batch, size, generator=draw, dtype=torch.float64) for size in (15, 3, 3)]


def histories(count, length=24):
    draw = torch.Generator().manual_seed(0)
    start, step = torch.rand(2, count, 1, 3, generator=draw, dtype=torch.float64) - 0.5
    ahead = torch.arange(length, dtype=torch.float64).clamp_min(length // 2).unsqueeze(-1)
    noise = 1e-4 * torch.rand(count, length, 3, generator=draw, dtype=torch.float64)
    history = start + 0.02 * step * ahead + noise
    history[:, : length // 2] = history[:, length // 2 : length // 2 + 1]
    history[0] = history[0, :1]
    return history


def spread_forecaster(settings=FORECASTERS[0]):
    network = forecaster(**settings)
    spread = SpreadNetwork(features=16, horizon=20, hidden=8, rank=4).double()
    torch.nn.init.normal_(spread.head.weight)
    return SpreadForecaster(network, spread).eval().requires_grad_(False)


def captures():
    torch.manual_seed(0)
    return CaptureNetwork(hidden=8).double().eval().requires_grad_(False)


def captured(network):
    return network.probability(histories(2, 80), samples(2, 1)[1], torch.tensor([40]))


@pytest.mark.parametrize("settings", FORECASTERS)
def test_a_forecaster_for_inference_forecasts_the_same(settings):
    network = forecaster(**settings)
    history = histories(60, network.config.history)
    forecast = network.for_inference()(history.view(5, 12, *history.shape[1:])).flatten(0, 1)
    torch.testing.assert_close(forecast, network(history), atol=1e-11, rtol=1e-11)
    assert forecast.std() > 0.1


@pytest.mark.parametrize("settings", [setting for setting in FORECASTERS if setting.get("half_extent")])
def test_a_forecaster_for_inference_is_described_the_same(settings):
    network = forecaster(**settings)
    history = histories(60, network.config.history)
    found = network.for_inference().describe(history.view(5, 12, *history.shape[1:]))
    for one, other in zip(found, network.describe(history), strict=True):
        torch.testing.assert_close(one.flatten(0, 1), other, atol=1e-11, rtol=1e-11)
    assert found[2].any() == bool(settings.get("square_symmetry"))
    assert not found[2].all()


@pytest.mark.parametrize("settings", FORECASTERS[:2])
def test_a_spread_is_the_same_beside_a_forecaster_for_inference(settings):
    whole, history = spread_forecaster(settings), histories(60)
    fast = whole.for_inference()
    found, expected = fast.predict(history.view(5, 12, 24, 3)), whole.predict(history)
    torch.testing.assert_close(found.path.flatten(0, 1), expected.path, atol=1e-11, rtol=1e-11)
    for one, other in zip(found.spread, expected.spread, strict=True):
        torch.testing.assert_close(one.flatten(0, 1), other)
    assert fast.history == whole.history == 24


def test_forecasts_for_inference_turn_exactly_with_their_histories():
    network, history = forecaster(**FORECASTERS[0]).for_inference(), histories(60)[1:]
    for symmetry in square_symmetries().double():
        assert torch.equal(network(history @ symmetry), network(history) @ symmetry)


@pytest.mark.parametrize("estimator", ["mode", "expectation", "distribution", "soft"])
def test_an_eta_for_inference_gives_the_same_arrivals(estimator):
    network, (state, goal, _) = arrivals(), samples(6, 5)
    fast = network.for_inference()
    torch.testing.assert_close(fast(state, goal), network(state, goal), atol=1e-12, rtol=1e-12)
    expected = network.arrival(state[:, :1], goal, estimator=estimator)
    ask = fast.from_state(state[:, 0])
    for found in (fast.arrival(state[:, :1], goal, estimator=estimator), ask(goal, estimator=estimator)):
        torch.testing.assert_close(found.steps, expected.steps)
        torch.testing.assert_close(found.never, expected.never)
        torch.testing.assert_close(found.bins, expected.bins)
        assert found.bin_width == expected.bin_width


ANSWERS = [
    (spread_forecaster, lambda network: network.predict(histories(2)).spread.scale),
    (spread_forecaster, lambda network: network.predict(histories(2)).path),
    (arrivals, lambda network: network(*samples(2)[:2])),
    (captures, captured),
]


@pytest.mark.parametrize(("make", "answer"), ANSWERS)
def test_a_network_for_inference_is_a_copy_that_holds_and_saves_no_weights(make, answer):
    network = make()
    fast = network.for_inference()
    before = answer(fast).clone()
    for value in network.parameters():
        value.add_(1.0)
    assert torch.equal(answer(fast), before)
    assert not torch.allclose(answer(network.for_inference()), before)
    assert not [*fast.parameters(), *fast.state_dict()]
    with pytest.raises(RuntimeError, match="Unexpected key"):
        fast.load_state_dict(network.state_dict())


@pytest.mark.parametrize("make", [spread_forecaster, arrivals, captures])
def test_a_network_for_inference_is_where_its_network_is(make, monkeypatch):
    # A device that is everywhere, but keeps no numbers: constants are computed from another network's.
    network = make()
    on_cpu = copy.deepcopy(getattr(network, "forecaster", network))
    monkeypatch.setattr(inference, "in_double", lambda _: on_cpu)
    assert {value.device.type for value in network.to("meta").for_inference().buffers()} == {"meta"}


def test_a_network_for_inference_follows_dtype():
    assert forecaster().float().for_inference()(histories(2).float()).dtype == torch.float32
    assert arrivals().for_inference().float()(*(x.float() for x in samples(2)[:2])).dtype == torch.float32


def test_wrong_inputs_are_named():
    network, fast = forecaster().for_inference(), arrivals().for_inference()
    state, goal, _ = samples(2)
    with pytest.raises(InputError, match=r"target_history.*24, 3.*\(2, 23, 3\)"):
        network(torch.zeros(2, 23, 3))
    with pytest.raises(InputError, match="target_history must be finite"):
        network(histories(2) * float("nan"))
    with pytest.raises(InputError, match=r"robot_state.*15.*\(2, 14\)"):
        fast(state[:, :14], goal)
    with pytest.raises(InputError, match="goal must be finite"):
        fast(state, goal * float("inf"))
    with pytest.raises(InputError, match="expectation"):
        fast.arrival(state, goal, estimator="expectaton")
