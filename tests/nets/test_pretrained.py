import json
import math
import time

import pytest
import torch
from safetensors.torch import load_file, save_file

from torchdyn_plan.errors import InputError, WeightsError
from torchdyn_plan.nets import Actor, ETANetwork, Forecaster


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


def rewritten(file, tensors=None, **metadata):
    """The file with other tensors or metadata."""
    save_file(load_file(file) if tensors is None else tensors, file, metadata_of(file) | metadata)
    return file


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_weights_that_are_no_numbers_are_neither_read_nor_written(network, tmp_path, value):
    file = network.save_pretrained(tmp_path)
    tensors = load_file(file)
    tensors["head.bias"][3] = value
    with pytest.raises(WeightsError, match=r"tensor 'head.bias' holds NaN or infinite values"):
        Forecaster.from_pretrained(rewritten(file, tensors))
    before = file.read_bytes()
    with torch.no_grad():
        network.head.bias[3] = value
    with pytest.raises(InputError, match=r"head.bias of Forecaster must be finite"):
        network.save_pretrained(tmp_path)
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    "dtype", [torch.float16, torch.bfloat16, torch.float64, torch.int64, torch.int32, torch.uint8, torch.bool]
)
def test_weights_of_another_type_are_refused(network, tmp_path, dtype):
    file = network.save_pretrained(tmp_path)
    tensors = load_file(file)
    with pytest.raises(WeightsError, match=r"tensor 'head.bias' is \w+, expected F32"):
        Forecaster.from_pretrained(rewritten(file, tensors | {"head.bias": tensors["head.bias"].to(dtype)}))


@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
def test_files_are_of_one_type_whatever_the_network(network, tmp_path, dtype):
    file = network.to(dtype).save_pretrained(tmp_path)
    assert {value.dtype for value in load_file(file).values()} == {torch.float32}
    assert torch.equal(Forecaster.from_pretrained(file).head.weight, network.head.weight.float())


HOSTILE = [
    *(
        {name: value}
        for name in ("history", "horizon", "channels", "convolutions", "hidden", "rank")
        for value in (10**9, 10**12, 10**30, -1, 0, 1.5, None, "300", [300], True)
    ),
    *({name: value} for name in ("step_scale", "half_extent") for value in (-1.0, "x", [], {}, 1e400)),
    {"square_symmetry": None},
]


@pytest.mark.parametrize("change", HOSTILE, ids=str)
def test_a_hostile_configuration_is_refused_at_once(network, tmp_path, change):
    file = network.save_pretrained(tmp_path)
    config = json.loads(metadata_of(file)["config"]) | change
    rewritten(file, config=json.dumps(config))
    started = time.process_time()
    with pytest.raises(WeightsError, match=r"forecaster\.safetensors'"):
        Forecaster.from_pretrained(file)
    assert time.process_time() - started < 5.0


@pytest.mark.parametrize(
    "change",
    [
        {"hidden": 10**9},
        {"tool_slice": [5, 5]},
        {"tool_slice": []},
        {"tool_slice": 3},
        {"tool_slice": [0, 10**12]},
        {"bins": 10**9},
        {"robot_state_size": 10**12},
        {"tool_slice": [[[0]], 3]},
        {"bin_width": 10**30},
    ],
    ids=str,
)
def test_empty_slices_and_endless_bins_are_refused(tmp_path, change):
    file = ETANetwork(hidden=8).save_pretrained(tmp_path)
    rewritten(file, config=json.dumps(json.loads(metadata_of(file)["config"]) | change))
    with pytest.raises(WeightsError, match=r"eta\.safetensors'"):
        ETANetwork.from_pretrained(file)


@pytest.mark.parametrize("change", [{"layers": 10**9}, {"layers": 10**5}, {"hidden": 10**9}], ids=str)
def test_endless_layers_are_refused(tmp_path, change):
    file = Actor(hidden=8, layers=1).save_pretrained(tmp_path)
    rewritten(file, config=json.dumps(json.loads(metadata_of(file)["config"]) | change))
    with pytest.raises(WeightsError, match=r"policy\.safetensors'"):
        Actor.from_pretrained(file)


@pytest.mark.parametrize(
    "config", ["[" * 10**5, '{"hidden": ' * 10**5, '{"hidden": NaN}', '"text"', "null", "1" * 5000]
)
def test_nested_and_endless_json_is_refused(network, tmp_path, config):
    file = rewritten(network.save_pretrained(tmp_path), config=config)
    with pytest.raises(WeightsError, match="invalid configuration of Forecaster"):
        Forecaster.from_pretrained(file)


def test_nothing_is_allocated_before_the_header_fits(network, tmp_path, monkeypatch):
    """A header may promise more than there is, and a configuration ask for what the file has not."""
    file = network.save_pretrained(tmp_path)
    rewritten(file, config=json.dumps(json.loads(metadata_of(file)["config"]) | {"hidden": 10**6}))
    monkeypatch.setattr(torch.nn.Linear, "reset_parameters", lambda layer: forbid(layer.weight))
    with pytest.raises(WeightsError, match="has shape"):
        Forecaster.from_pretrained(file)


def forbid(tensor):
    assert tensor.is_meta, "memory was taken"
