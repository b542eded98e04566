import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

from tests.training.rolling import EXTENT, write_paths
from tests.training.test_fit import kill_at_step
from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.errors import InputError, TrainingError
from torchdyn_plan.nets import Forecaster, ForecasterConfig, SpreadNetwork
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper import data as module
from torchdyn_plan.training.fit_spread import fit_spread, spread_loss
from torchdyn_plan.training.fitting import RECIPES
from torchdyn_plan.training.windows import Windows

TASK = load_task("trapper")
SMALL = ForecasterConfig(hidden=32, channels=8, square_symmetry=True, half_extent=EXTENT)


@pytest.fixture
def parts(tmp_path, monkeypatch):
    """Folder of data, and file of a small forecaster that is none too good."""
    monkeypatch.setattr("torchdyn_plan.training.path_data.SCORED", 64)
    monkeypatch.setattr(module, "ROLLED", 6)
    monkeypatch.setattr(module, "FRICTIONS", (0.0, 9.5))
    monkeypatch.setattr(module, "PRESENTS", (30,))
    folder = tmp_path / "data"
    folder.mkdir()
    write_paths(folder)
    torch.manual_seed(0)
    return folder, Forecaster(SMALL).save_pretrained(tmp_path / "forecaster")


def fit_with(data, out, forecaster, **recipe):
    """A fit by its own recipe, but for some fields."""
    return fit_spread(TASK, data, out, replace(RECIPES["spread"], **recipe), forecaster=forecaster)


def test_spread_learns_and_leaves_weights_curve_scores_and_card(parts, tmp_path):
    data, forecaster = parts
    before = forecaster.read_bytes()
    file = fit_with(data, tmp_path, forecaster, steps=30, batch=32, lr=3e-3)
    assert file == tmp_path / "spread" / "spread.safetensors"
    network = SpreadNetwork.from_pretrained(tmp_path / "spread")
    assert network.config.features == SMALL.hidden
    assert forecaster.read_bytes() == before
    curve = json.loads((file.parent / "curve.json").read_text())
    assert curve[-1]["loss_held"] < curve[0]["loss_held"]
    tables = json.loads((file.parent / "scores.json").read_text())
    held, gone, rough = tables.values()
    assert {row["ahead"] for row in held} == {row["ahead"] for row in gone} == {25, 100, 300}
    assert {row["friction"] for row in rough} == {0.0, 9.5}
    card = file.with_suffix(".md").read_text()
    for text in (
        "train spread --task trapper --steps 30",
        TrapperScene().digest(),
        "within_50",
        "| 9.5 | full | 300 |",
    ):
        assert text in card


def test_same_seed_same_weights_and_resumed_alike(parts, tmp_path, monkeypatch):
    data, forecaster = parts
    settings = {"steps": 4, "batch": 16, "seed": 4}
    whole = load_file(fit_with(data, tmp_path / "whole", forecaster, **settings))
    with monkeypatch.context() as patch:
        kill_at_step(patch, 3)
        with pytest.raises(KeyboardInterrupt):
            fit_with(data, tmp_path / "cut", forecaster, **settings)
    rest = load_file(fit_with(data, tmp_path / "cut", forecaster, **settings))
    assert all(torch.equal(rest[name], whole[name]) for name in whole)
    with pytest.raises(TrainingError, match="made with batch 16, not 8"):
        fit_with(data, tmp_path / "cut", forecaster, **settings | {"batch": 8})


def test_missing_data_is_named(tmp_path):
    with pytest.raises(InputError, match="no paths-"):
        fit_with(tmp_path, tmp_path, "trapper")


def test_a_task_without_a_spread_is_named(tmp_path):
    task = load_task("fetch_reach")
    with pytest.raises(InputError, match="fetch_reach has no spread to fit"):
        fit_spread(task, tmp_path, tmp_path, forecaster=task.name)


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


def test_lost_targets_count_by_their_probability_only():
    assert loss_of(0.01, gone=-20.0) < loss_of(0.01, gone=0.0)
    assert loss_of(0.01, gone=20.0, recorded=1) < loss_of(0.01, gone=0.0, recorded=1)
