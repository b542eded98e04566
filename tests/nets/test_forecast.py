import pytest
import torch
from torch import nn

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import Forecast, Forecaster, FunctionForecast, Spread


def forecast(horizon=9):
    path = torch.arange(1.0, horizon + 1)[:, None].expand(2, horizon, 3)
    share = torch.linspace(0.0, 1.0, horizon).expand(2, horizon)
    return Forecast(path, Spread(path[..., :2], 2 * path[..., :2], share))


def test_a_forecast_is_counted_from_later():
    whole = forecast()
    later = whole.after(4)
    assert later.path[0, :, 0].tolist() == [5, 6, 7, 8, 9]
    assert later.spread.scale[1, :, 1].tolist() == [5, 6, 7, 8, 9]
    assert torch.equal(later.spread.gone, whole.spread.gone[:, 4:])
    assert whole.after(0) is whole
    assert Forecast(whole.path).after(4).spread is None
    with pytest.raises(InputError, match="delay must be below the forecast's 9 steps, got 9"):
        whole.after(9)


def test_a_function_or_a_module_may_stand_in():
    history = torch.rand(2, 6, 3)
    assert torch.equal(FunctionForecast.wrap(lambda seen: seen + 1).predict(history).path, history + 1)
    told = forecast()
    assert FunctionForecast.wrap(lambda _: told).predict(history) is told
    model = FunctionForecast(nn.Identity(), in_keys=("camera",))
    assert (model.in_keys, model.history) == (("camera",), None)
    assert model.for_inference() is model


def test_a_model_is_taken_as_it_is_and_what_cannot_be_called_is_refused():
    network = Forecaster(hidden=8)
    assert FunctionForecast.wrap(network) is network
    with pytest.raises(InputError, match=r"forecaster must be a ForecastModel or a function.*got 3"):
        FunctionForecast.wrap(3)
