import pytest
import torch

from tests.nets.test_forecaster import histories
from torchdyn_plan.errors import InputError, WeightsError
from torchdyn_plan.nets import Forecaster, Spread, SpreadConfig, SpreadNetwork
from torchdyn_plan.nets.symmetry import square_symmetries


@pytest.fixture
def networks():
    torch.manual_seed(0)
    forecaster = Forecaster(horizon=20, hidden=16, channels=8, square_symmetry=True, half_extent=0.7)
    forecaster.head.weight.data.normal_()
    spread = SpreadNetwork(features=16, horizon=20, hidden=8, rank=4)
    spread.head.weight.data.normal_()
    return forecaster.double().eval(), spread.double().eval()


def told(networks, history):
    forecaster, spread = networks
    _, features, swapped = forecaster.describe(history)
    return spread(features, swapped)


def test_describing_leaves_the_forecast_as_it_is(networks):
    history = histories(2, 5)
    forecast, features, swapped = networks[0].describe(history)
    assert torch.equal(forecast, networks[0](history))
    assert features.shape == (2, 5, 16)
    assert swapped.shape == (2, 5)
    assert 0 < swapped.sum() < 10


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_batch_is_free_and_equals_a_loop(networks, batch):
    history = histories(*batch)
    whole = told(networks, history)
    assert whole.scale.shape == whole.shape.shape == (*batch, 20, 2)
    assert whole.gone.shape == (*batch, 20)
    for part, name in zip(whole, Spread._fields, strict=True):
        rows = [getattr(told(networks, row), name) for row in history.reshape(-1, 24, 3)]
        torch.testing.assert_close(part.reshape(-1, *part.shape[len(batch) :]), torch.stack(rows))


def test_mirrored_histories_have_the_same_spread_and_turned_ones_a_turned_one(networks):
    history = histories(40)
    whole = told(networks, history)
    for symmetry in square_symmetries().double():
        other = told(networks, history @ symmetry)
        swapped = bool(symmetry[0, 0] == 0)
        for name in ("scale", "shape"):
            expected = getattr(whole, name)
            assert torch.equal(getattr(other, name), expected.flip(-1) if swapped else expected)
        assert torch.equal(other.gone, whole.gone)
    assert not torch.equal(whole.scale, whole.scale.flip(-1))


def example(*values):
    scale, shape = torch.tensor([[values[:2]]]).double(), torch.tensor([[values[2:]]]).double()
    return Spread(scale, shape, torch.zeros(1, 1).double())


def test_half_of_all_errors_are_within_the_scale_and_intervals_hold_their_share():
    spread = example(0.01, 0.2, 1.5, 3.0)
    torch.testing.assert_close(spread.within(spread.scale), torch.full((1, 1, 2), 0.5).double())
    for share in (0.1, 0.5, 0.8, 0.95):
        torch.testing.assert_close(spread.within(spread.interval(share)), torch.full((1, 1, 2), share).double())


def test_probabilities_rise_from_0_to_1_with_size_and_fall_with_spread():
    sizes = torch.logspace(-8, 4, 50).double().view(-1, 1, 1)
    inside = example(0.01, 0.2, 1.5, 3.0).within(torch.cat([torch.zeros(1, 1, 1), sizes]))
    assert bool((inside.diff(dim=0) >= 0).all())
    assert inside[0].tolist() == [[0.0, 0.0]]
    assert inside[-1].min() > 0.999
    assert bool((example(0.02, 0.3, 1.5, 3.0).within(0.1) < example(0.01, 0.2, 1.5, 3.0).within(0.1)).all())


def test_between_counts_both_sides_of_an_offset_place():
    spread, draw = example(0.02, 0.05, 2.0, 3.0), torch.Generator().manual_seed(0)
    uniform = torch.rand(200_000, 2, generator=draw, dtype=torch.float64)
    error = spread.scale * (uniform / (1 - uniform)) ** (1 / spread.shape)
    error = error * torch.where(torch.rand(200_000, 2, generator=draw) < 0.5, 1.0, -1.0)
    for offset in (0.0, 0.03, -0.03, 0.055, -0.08):
        expected = ((error + offset).abs() <= 0.055).double().mean(-2)
        found = spread.between(torch.full((1, 1, 2), offset).double(), 0.055)
        torch.testing.assert_close(found[0], expected, atol=4e-3, rtol=0)


def test_gradients_match_differences_at_the_edge_too():
    scale = torch.tensor([[0.01, 0.3]], dtype=torch.float64, requires_grad=True)
    shape = torch.tensor([[0.7, 2.0]], dtype=torch.float64, requires_grad=True)
    offset = torch.tensor([[0.02, 0.0]], dtype=torch.float64, requires_grad=True)

    def between(scale, shape, offset):
        return Spread(scale, shape, scale[..., 0]).between(offset, 0.05)

    assert torch.autograd.gradcheck(lambda s, k: between(s, k, offset.detach()), (scale, shape))
    between(scale, shape, torch.full_like(offset, 0.05).requires_grad_()).sum().backward()
    assert bool(scale.grad.isfinite().all())


def test_gradient_of_the_network_matches_differences(networks):
    features = torch.randn(3, 16, dtype=torch.float64, requires_grad=True)
    swapped = torch.tensor([True, False, True])
    assert torch.autograd.gradcheck(lambda x: tuple(part[:, ::7] for part in networks[1](x, swapped)), features)


def test_it_comes_back_from_its_file(networks, tmp_path):
    network = networks[1].float()
    file = network.save_pretrained(tmp_path)
    assert file.name == "spread.safetensors"
    again = SpreadNetwork.from_pretrained(tmp_path)
    assert again.config == network.config
    features, swapped = torch.randn(2, 16), torch.tensor([True, False])
    assert torch.equal(again(features, swapped).scale, network(features, swapped).scale)
    with pytest.raises(WeightsError, match="SpreadNetwork"):
        SpreadNetwork.from_pretrained("nothing")


@pytest.mark.parametrize(
    ("features", "swapped", "message"),
    [
        (torch.zeros(2, 15), torch.zeros(2, dtype=torch.bool), "features.*16"),
        (torch.zeros(2, 16), torch.zeros(3, dtype=torch.bool), r"swapped must be bool of shape \(2,\)"),
        (torch.zeros(2, 16), torch.zeros(2), "swapped must be bool"),
    ],
)
def test_wrong_inputs_are_named(networks, features, swapped, message):
    with pytest.raises(InputError, match=message):
        networks[1].float()(features, swapped)


@pytest.mark.parametrize("settings", [{"features": 0}, {"horizon": 0}, {"rank": 1.5}, {"finest": 0.0}])
def test_wrong_settings_are_named(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        SpreadConfig(**settings)
