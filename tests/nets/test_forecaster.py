import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import Ballistic, Forecaster, ForecasterConfig
from torchdyn_plan.nets.symmetry import octant, square_symmetries


@pytest.fixture(params=[None, 0.7], ids=["open", "cushions"])
def network(request):
    torch.manual_seed(0)
    network = Forecaster(horizon=20, hidden=16, channels=8, square_symmetry=True, half_extent=request.param)
    # As large as after a training, so that nothing vanishes beside constant velocity.
    network.head.weight.data.normal_()
    return network.double().eval()


def histories(*batch, seed=0):
    draw = torch.Generator().manual_seed(seed)
    start = torch.rand(*batch, 1, 3, generator=draw, dtype=torch.float64) - 0.5
    step = 0.02 * torch.rand(*batch, 1, 3, generator=draw, dtype=torch.float64) - 0.01
    noise = 1e-4 * torch.rand(*batch, 24, 3, generator=draw, dtype=torch.float64)
    return start + step * torch.arange(24, dtype=torch.float64).unsqueeze(-1) + noise


def test_symmetries_are_a_group_and_reach_the_first_octant():
    group = square_symmetries()
    products = (group[:, None] @ group).flatten(0, 1)
    assert all(any(torch.equal(product, element) for element in group) for product in products)
    assert len(group.unique(dim=0)) == 8
    direction = torch.randn(200, 3)
    turned = (direction.unsqueeze(-2) @ group[octant(direction[:, :2])]).squeeze(-2)
    assert bool((turned[:, 0] >= turned[:, 1]).all())
    assert bool((turned[:, 1] >= 0).all())


def test_forecasts_turn_exactly_with_their_histories(network):
    history = histories(50)
    for symmetry in square_symmetries().double():
        assert torch.equal(network(history @ symmetry), network(history) @ symmetry)


def test_without_symmetry_forecasts_do_not_turn():
    network = Forecaster(horizon=20, hidden=16).double()
    history, symmetry = histories(5), square_symmetries()[1].double()
    assert not torch.allclose(network(history @ symmetry), network(history) @ symmetry, atol=1e-6)


@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3)])
def test_batch_is_free_and_equals_a_loop(network, batch):
    history = histories(*batch)
    forecast = network(history)
    assert forecast.shape == (*batch, 20, 3)
    assert forecast.dtype == torch.float64
    rows = [network(row) for row in history.reshape(-1, 24, 3)]
    torch.testing.assert_close(forecast.reshape(-1, 20, 3), torch.stack(rows))


def test_forecast_is_the_reflected_line(network):
    history = histories(50)
    line, forecast = network.unreflected(history), network(history)
    extent = network.config.half_extent
    if extent is None:
        assert torch.equal(line, forecast)
    else:
        assert line[..., :2].abs().max() > extent >= forecast[..., :2].abs().max()
        inside = line[..., :2].abs().amax(-1) < extent
        torch.testing.assert_close(forecast[inside], line[inside])


def test_a_network_that_adds_nothing_goes_on_at_constant_velocity():
    network = Forecaster(horizon=20, hidden=16, square_symmetry=True)
    network.head.weight.data.zero_()
    history = histories(4).float()
    step = history[:, -1:] - history[:, -2:-1]
    expected = history[:, -1:, :2] + torch.arange(1.0, 21.0).view(-1, 1) * step[..., :2]
    torch.testing.assert_close(network(history)[..., :2], expected)


@pytest.mark.parametrize("drag", [0.0, 0.05])
def test_a_network_that_adds_nothing_flies_on_by_the_law(drag):
    law = {"gravity": (0.0, 0.0, -9.81), "drag": drag, "control_step": 0.008}
    network = Forecaster(horizon=20, hidden=16, **law).double()
    network.head.weight.data.zero_()
    history = histories(2, 3)
    torch.testing.assert_close(network(history), Ballistic(horizon=20, **law).predict(history).path)


def test_what_gravity_does_to_the_history_is_not_seen():
    torch.manual_seed(0)
    falling, floating = (
        Forecaster(horizon=20, hidden=16, gravity=(0.0, 0.0, fall), control_step=0.01).double() for fall in (-9.81, 0.0)
    )
    floating.load_state_dict(falling.state_dict())
    place, step = histories(2, 5)[..., -1, :].unsqueeze(-2)
    ago = torch.arange(23.0, -1.0, -1.0, dtype=torch.float64).unsqueeze(-1)
    straight = place - 0.1 * ago * step
    # With the same last step, and half a padded history.
    parabola = straight + 0.5 * 0.01**2 * torch.tensor([0.0, 0.0, -9.81]) * ago * (ago - 1.0)
    straight[:, :12], parabola[:, :12] = straight[:, 12:13], parabola[:, 12:13]
    added = [
        network(history) - network.law.continued(history[:, -1], history[:, -1] - history[:, -2])
        for network, history in ((falling, parabola), (floating, straight))
    ]
    torch.testing.assert_close(*added, atol=1e-6, rtol=1e-6)
    assert added[0].std() > 1e-6


def test_padding_is_seen_as_padding(network):
    history = histories(1)
    padded = torch.cat([history[:, 12:13].expand(-1, 12, -1), history[:, 12:]], dim=1)
    assert not torch.allclose(network(padded), network(history))
    assert not network._step_features(padded.diff(dim=-2))[:, :11, 2:].any()


def test_gradient_matches_differences(network):
    history = histories(2).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: network(x)[:, ::7], history, eps=1e-9, atol=1e-3, rtol=1e-3)


def test_gradient_is_finite_for_a_target_at_rest(network):
    history = torch.zeros(2, 24, 3, dtype=torch.float64).requires_grad_()
    network(history).sum().backward()
    assert bool(history.grad.isfinite().all())


@pytest.mark.parametrize(
    ("history", "message"),
    [
        (torch.zeros(2, 23, 3), r"target_history.*24, 3.*\(2, 23, 3\)"),
        (torch.zeros(2, 24, 4), r"target_history.*\(2, 24, 4\)"),
        (torch.full((2, 24, 3), float("nan")), "target_history must be finite"),
        (torch.zeros(2, 24, 3, device="meta"), "target_history is on meta"),
    ],
)
def test_wrong_histories_are_named(history, message):
    with pytest.raises(InputError, match=message):
        Forecaster(hidden=8)(history)


@pytest.mark.parametrize(
    "settings",
    [
        {"history": 1},
        {"horizon": 0},
        {"half_extent": -1.0},
        {"square_symmetry": 1},
        {"step_scale": float("nan")},
        {"gravity": (0.0, -9.81)},
        {"gravity": (0.0, 0.0, -9.81), "half_extent": 0.7},
        {"drag": -1.0},
    ],
)
def test_wrong_settings_are_named(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        ForecasterConfig(**settings)
