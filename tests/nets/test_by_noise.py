"""Two forecasters of which the noise of the measurements chooses one, and what a tracked one reads."""

import pytest
import torch

from tests.planners.toy import HISTORY, Straight, make_planner, observation
from torchdyn_plan import keys
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import ForecastByNoise, Forecaster, ForecasterConfig, SpreadForecaster, SpreadNetwork
from torchdyn_plan.planners import EventSchedule, KalmanTrack, ReplanSchedule, TrackedPlanner
from torchdyn_plan.planners.schedule import starting_at

SIZES = {"history": 8, "stride": 2, "horizon": 30, "channels": 4, "hidden": 16, "rank": 4, "convolutions": 1}


def forecaster(**settings):
    torch.manual_seed(0)
    network = Forecaster(**(SIZES | {"tracked": True} | settings)).eval().requires_grad_(False)
    network.head.weight.mul_(50.0)
    return network


def seen(*batch, dtype=torch.float32):
    draw = torch.Generator().manual_seed(1)
    line = torch.randn(*batch, 1, 3, generator=draw) * 0.2
    step = torch.randn(*batch, 1, 3, generator=draw) * 0.004
    root = torch.randn(*batch, 2, 2, generator=draw) * 0.01
    covariance = root @ root.mT + 1e-6 * torch.eye(2)
    return (line + step * torch.arange(8.0).unsqueeze(-1)).to(dtype), covariance.to(dtype)


class Late(Straight):
    """Needs three samples, and tells that it was asked."""

    samples = 3


def by_noise(**settings):
    return ForecastByNoise(Straight(), Late(), **settings)


def test_what_is_known_of_a_target_changes_its_forecast():
    network, (history, covariance) = forecaster(), seen(5)
    assert network.in_keys == (keys.TARGET_HISTORY, keys.TARGET_COVARIANCE)
    apart = (network(history, covariance) - network(history, 100.0 * covariance)).abs().amax((-2, -1))
    assert (apart > 1e-4).all()


@pytest.mark.parametrize("settings", [{}, {"square_symmetry": True, "half_extent": 0.7}])
def test_the_copy_for_inference_is_the_same_function(settings):
    network, spread = forecaster(**settings), SpreadNetwork(features=16, horizon=30, tracked=True)
    model = SpreadForecaster(network, spread.eval().requires_grad_(False))
    one, other = (made.predict(*seen(4, 3)) for made in (model, model.for_inference()))
    torch.testing.assert_close(one.path, other.path, atol=2e-6, rtol=0.0)
    torch.testing.assert_close(one.spread, other.spread, atol=1e-5, rtol=1e-4)
    assert model.for_inference().in_keys == model.in_keys


def test_a_stride_reads_every_second_position_and_the_newest():
    network, (history, covariance) = forecaster(), seen(2)
    kept, other = history.clone(), history.clone()
    kept[:, 0] += 1.0
    other[:, 1] += 1.0
    assert torch.equal(network(kept, covariance), network(history, covariance))
    assert not torch.equal(network(other, covariance), network(history, covariance))


def test_turned_targets_have_turned_forecasts_and_rows_do_not_depend_on_one_another():
    network = forecaster(square_symmetry=True)
    history, covariance = seen(6)
    turn = network.symmetries[5]
    turned = network(history @ turn, covariance)
    torch.testing.assert_close(turned, network(history, covariance) @ turn, atol=1e-6, rtol=0.0)
    one = network(history[2:3], covariance[2:3])
    torch.testing.assert_close(one, network(history, covariance)[2:3], atol=1e-6, rtol=0.0)


def test_a_missing_or_misshapen_covariance_is_named():
    network, (history, covariance) = forecaster(), seen(3)
    for model in (network, network.for_inference()):
        with pytest.raises(InputError, match="tracked forecaster reads target_covariance"):
            model(history)
        with pytest.raises(InputError, match="target_covariance"):
            model(history, covariance[:2])
        with pytest.raises(InputError, match="target_covariance"):
            model(history, covariance[..., :1])
    with pytest.raises(InputError, match="multiple of stride = 3, got 8"):
        ForecasterConfig(history=8, stride=3)


def test_the_noise_chooses():
    both = by_noise(least_noise=0.001)
    assert both.for_noise(0.0009) is both
    assert both.for_noise(0.001) is both.noisy
    assert both.chosen is both.exact
    history = observation((2,))[keys.TARGET_HISTORY]
    assert torch.equal(both.predict(history).path, both.exact.predict(history).path)
    assert both.noisy.rows == []
    assert Straight().for_noise(1.0).__class__ is Straight
    with pytest.raises(InputError, match="least_noise"):
        by_noise(least_noise=-1.0)


@pytest.mark.parametrize(("noise", "kind", "first"), [(1e-4, ForecastByNoise, 3), (0.005, Late, 2)])
def test_a_tracked_planner_takes_the_forecaster_for_its_noise(noise, kind, first):
    planner = make_planner().with_parts(forecaster=by_noise())
    tracked = TrackedPlanner(planner, KalmanTrack(noise=noise), control_step=0.01, history=HISTORY)
    assert type(tracked.planner.forecaster) is kind
    assert tracked.planner.schedule.first_step == first
    assert tracked.planner.schedule.window == planner.schedule.window


def test_a_schedule_that_does_not_say_when_it_begins_stays():
    schedule = object()
    assert starting_at(schedule, 1) is schedule
    assert starting_at(EventSchedule(every=10, minimum=10), 1) == EventSchedule(every=10, minimum=10, first_step=1)
    assert starting_at(ReplanSchedule.every(5, first_step=13), 1) == ReplanSchedule.every(5)
