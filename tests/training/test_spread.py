import json

import pytest
import torch
from safetensors.torch import load_file

from tests.training.rolling import EXTENT, write_paths
from tests.training.test_fit import kill_at_step
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.errors import InputError, TrainingError
from torchdyn_plan.nets import Forecaster, ForecasterConfig, SpreadNetwork
from torchdyn_plan.training import spread as module
from torchdyn_plan.training.spread import fit_spread, rolled_windows, spread_loss
from torchdyn_plan.training.windows import WindowConfig, Windows

SMALL = ForecasterConfig(hidden=32, channels=8, square_symmetry=True, half_extent=EXTENT)


@pytest.fixture
def parts(tmp_path, monkeypatch):
    """Folder of data, and settings of a fit to a small forecaster that is none too good."""
    monkeypatch.setattr("torchdyn_plan.training.fit.SCORED", 64)
    monkeypatch.setattr(module, "ROLLED", 6)
    monkeypatch.setattr(module, "FRICTIONS", (0.0, 9.5))
    monkeypatch.setattr(module, "PRESENTS", (30,))
    folder = tmp_path / "data"
    folder.mkdir()
    write_paths(folder)
    torch.manual_seed(0)
    return folder, {"forecaster": Forecaster(SMALL).save_pretrained(tmp_path / "forecaster")}


def test_spread_learns_and_leaves_weights_curve_coverage_and_card(parts, tmp_path):
    data, settings = parts
    before = settings["forecaster"].read_bytes()
    file = fit_spread(data, tmp_path, steps=30, batch=32, lr=3e-3, **settings)
    assert file == tmp_path / "spread" / "spread.safetensors"
    network = SpreadNetwork.from_pretrained(tmp_path / "spread")
    assert network.config.features == SMALL.hidden
    assert settings["forecaster"].read_bytes() == before
    curve = json.loads((file.parent / "curve.json").read_text())
    assert curve[-1]["loss_held"] < curve[0]["loss_held"]
    tables = json.loads((file.parent / "coverage.json").read_text())
    held, gone, rough = tables.values()
    assert {row["ahead"] for row in held} == {row["ahead"] for row in gone} == {25, 100, 300}
    assert {row["friction"] for row in rough} == {0.0, 9.5}
    card = file.with_suffix(".md").read_text()
    for text in ("train spread --steps 30", TrapperScene().digest(), "within_50", "| 9.5 | full | 300 |"):
        assert text in card


def test_same_seed_same_weights_and_resumed_alike(parts, tmp_path, monkeypatch):
    data, settings = parts
    settings |= {"steps": 4, "batch": 16, "seed": 4}
    whole = load_file(fit_spread(data, tmp_path / "whole", **settings))
    with monkeypatch.context() as patch:
        kill_at_step(patch, 3)
        with pytest.raises(KeyboardInterrupt):
            fit_spread(data, tmp_path / "cut", **settings)
    rest = load_file(fit_spread(data, tmp_path / "cut", **settings))
    assert all(torch.equal(rest[name], whole[name]) for name in whole)
    with pytest.raises(TrainingError, match="made with batch 16, not 8"):
        fit_spread(data, tmp_path / "cut", **settings | {"batch": 8})


def test_missing_data_is_named(tmp_path):
    with pytest.raises(InputError, match="no paths-"):
        fit_spread(tmp_path, tmp_path)


def loss_of(error, *, scale=0.01, gone=-20.0, recorded=300):
    """Loss of a network that tells ``scale`` everywhere, for a forecast that is off by ``error``."""
    torch.manual_seed(0)
    forecaster, network = Forecaster(SMALL), SpreadNetwork(features=32)
    network.head.weight.data.zero_()
    bias = network.head.bias.data.view(5, 300)
    bias[:2], bias[2:4], bias[4] = torch.tensor(scale).log(), 0.7, gone
    history = 0.01 * torch.arange(24.0).view(1, -1, 1) * torch.tensor([1.0, 0.4, 0.0])
    with torch.no_grad():
        future = forecaster(history) + error * torch.tensor([1.0, 1.0, 0.0])
    kept = torch.arange(300).unsqueeze(0) < recorded
    yes = torch.tensor([True])
    windows = Windows(history, torch.tensor([24]), future, kept, ~yes if recorded == 300 else yes, yes)
    return spread_loss(forecaster, network, windows).item()


def test_the_loss_is_least_where_the_scale_is_the_error():
    losses = {scale: loss_of(0.01, scale=scale) for scale in (0.001, 0.005, 0.01, 0.02, 0.1)}
    assert min(losses, key=losses.__getitem__) == 0.01


def test_swallowed_targets_count_by_their_probability_only():
    assert loss_of(0.01, gone=-20.0) < loss_of(0.01, gone=0.0)
    assert loss_of(0.01, gone=20.0, recorded=1) < loss_of(0.01, gone=0.0, recorded=1)


def test_windows_of_rolled_balls_brake_with_friction(monkeypatch):
    monkeypatch.setattr(module, "ROLLED", 8)
    monkeypatch.setattr(module, "PRESENTS", (40,))
    way = {}
    for friction in (0.0, 9.5):
        windows = rolled_windows(TrapperScene(), WindowConfig(), friction=friction)
        assert windows.future.shape[1:] == (300, 3)
        way[friction] = windows.future[:, :50].diff(dim=1).norm(dim=-1).sum(1).mean()
    assert way[9.5] < way[0.0]
