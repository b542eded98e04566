import pytest
import torch
from safetensors.torch import load_file, save_file

from torchdyn_plan.errors import WeightsError
from torchdyn_plan.nets import ETANetwork, Forecaster


@pytest.fixture
def network():
    torch.manual_seed(3)
    return Forecaster(horizon=10, hidden=8, half_extent=0.7, square_symmetry=True).eval()


@pytest.mark.parametrize("place", ["", "other.safetensors", "new/folder"])
def test_round_trip(network, tmp_path, place):
    file = network.save_pretrained(tmp_path / place)
    for source in (file, file.parent) if file.name == "forecaster.safetensors" else (file,):
        loaded = Forecaster.from_pretrained(source)
        assert loaded.config == network.config
        assert not loaded.training
        history = torch.rand(3, 24, 3)
        assert torch.equal(loaded(history), network(history))


def test_round_trip_of_tuples_and_buffers(tmp_path):
    network = ETANetwork(hidden=8)
    network.set_input_statistics(torch.rand(50, 15), torch.rand(50, 3))
    loaded = ETANetwork.from_pretrained(network.save_pretrained(tmp_path))
    assert loaded.config == network.config
    assert torch.equal(loaded.state_scale, network.state_scale)


@pytest.mark.parametrize("kept", [0, 5, 200, -4])
def test_truncated_file(network, tmp_path, kept):
    file = network.save_pretrained(tmp_path)
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(WeightsError, match=r"forecaster\.safetensors.*not a whole safetensors file"):
        Forecaster.from_pretrained(file)


def test_another_network(network, tmp_path):
    file = network.save_pretrained(tmp_path)
    with pytest.raises(WeightsError, match="holds Forecaster, expected ETANetwork"):
        ETANetwork.from_pretrained(file)


def test_foreign_file(tmp_path):
    file = tmp_path / "model.safetensors"
    save_file({"weight": torch.zeros(2)}, file)
    with pytest.raises(WeightsError, match="holds no network of this package, expected Forecaster"):
        Forecaster.from_pretrained(file)


def metadata_of(file):
    from safetensors import safe_open

    with safe_open(file, framework="pt") as content:
        return content.metadata()


def test_missing_foreign_and_misshapen_tensors(network, tmp_path):
    file = network.save_pretrained(tmp_path)
    tensors, metadata = load_file(file), metadata_of(file)
    for changed, message in (
        ({name: value for name, value in tensors.items() if name != "head.bias"}, "lacks the tensor 'head.bias'"),
        (tensors | {"more": torch.zeros(1)}, "foreign tensor 'more'"),
        (tensors | {"head.bias": torch.zeros(7)}, r"'head.bias' has shape \(7,\), expected \(30,\)"),
    ):
        save_file(changed, file, metadata)
        with pytest.raises(WeightsError, match=message):
            Forecaster.from_pretrained(file)


@pytest.mark.parametrize("config", ['{"horizon": 0}', '{"horizons": 3}', "{", "[1]"])
def test_invalid_configuration(network, tmp_path, config):
    file = network.save_pretrained(tmp_path)
    save_file(load_file(file), file, metadata_of(file) | {"config": config})
    with pytest.raises(WeightsError, match="invalid configuration of Forecaster"):
        Forecaster.from_pretrained(file)


def test_missing_name_tells_what_there_is():
    with pytest.raises(WeightsError, match=r"no weights 'nowhere' for ETANetwork.*names that ship"):
        ETANetwork.from_pretrained("nowhere")
