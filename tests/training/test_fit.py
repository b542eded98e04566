import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

from tests.training.rolling import EXTENT, describe, write_arrivals, write_paths
from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.errors import InputError, TrainingError
from torchdyn_plan.nets import ETAConfig, ETANetwork, Forecaster, ForecasterConfig
from torchdyn_plan.tasks import load_task
from torchdyn_plan.training.fit import fit_eta, fit_forecaster, line_loss
from torchdyn_plan.training.fitting import RECIPES
from torchdyn_plan.training.windows import Windows

TASK = load_task("trapper")
SMALL = ForecasterConfig(hidden=32, channels=8, square_symmetry=True, half_extent=EXTENT)


def fit_with(fit, data, out, *, config=None, **recipe):
    """A fit by its own recipe, but for some fields."""
    own = RECIPES["forecaster" if fit is fit_forecaster else "eta"]
    return fit(TASK, data, out, replace(own, **recipe), config=config)


@pytest.fixture
def data(tmp_path, monkeypatch):
    monkeypatch.setattr("torchdyn_plan.training.fit.ROWS", 64)
    monkeypatch.setattr("torchdyn_plan.training.path_data.SCORED", 64)
    folder = tmp_path / "data"
    folder.mkdir()
    write_paths(folder)
    write_arrivals(folder)
    return folder


def test_forecaster_learns_and_leaves_weights_curve_and_card(data, tmp_path):
    file = fit_with(fit_forecaster, data, tmp_path, steps=30, batch=32, lr=3e-3, config=SMALL)
    assert file == tmp_path / "forecaster" / "forecaster.safetensors"
    network = Forecaster.from_pretrained(tmp_path / "forecaster")
    assert network.config == SMALL
    curve = json.loads((file.parent / "curve.json").read_text())
    assert curve[-1]["loss"] < curve[0]["loss"]
    assert {"full_25", "padded_300", "lost_false"} <= curve[-1].keys()
    card = file.with_suffix(".md").read_text()
    for text in (
        "train forecaster --task trapper --steps 30",
        TrapperScene().digest(),
        "episodes: 12",
        "torch",
        "| full | 300 |",
    ):
        assert text in card


def test_eta_learns_and_leaves_weights_curve_and_card(data, tmp_path):
    file = fit_with(fit_eta, data, tmp_path, steps=300, batch=64, lr=3e-3, config=ETAConfig(hidden=32))
    network = ETANetwork.from_pretrained(file)
    tool = torch.zeros(1, 15)
    found = network.arrival(tool, torch.tensor([[0.3, 0.0, 0.4], [0.9, 0.9, 0.9]]), estimator="expectation")
    assert found.steps[0].item() == pytest.approx(50, abs=12)
    assert found.never.tolist() == [False, True]
    assert {"mode_all_mean", "expectation_all_p95"} <= json.loads((file.parent / "curve.json").read_text())[-1].keys()
    card = file.with_suffix(".md").read_text()
    for text in (
        "train eta --task trapper --static ik --steps 300",
        TrapperScene().digest(),
        "samples: 200",
        "| at rest | expectation |",
    ):
        assert text in card


@pytest.mark.parametrize("fit", [fit_forecaster, fit_eta])
def test_same_seed_same_weights_and_resumed_alike(data, tmp_path, fit, monkeypatch):
    settings = {"steps": 4, "batch": 16, "seed": 4}
    if fit is fit_forecaster:
        settings["config"] = SMALL
    whole = load_file(fit_with(fit, data, tmp_path / "whole", **settings))
    with monkeypatch.context() as patch:
        kill_at_step(patch, 3)
        with pytest.raises(KeyboardInterrupt):
            fit_with(fit, data, tmp_path / "cut", **settings)
    rest = load_file(fit_with(fit, data, tmp_path / "cut", **settings))
    assert all(torch.equal(rest[name], whole[name]) for name in whole)
    other = load_file(fit_with(fit, data, tmp_path / "other", **settings | {"seed": 5}))
    assert not torch.equal(other["head.weight"], whole["head.weight"])
    with pytest.raises(TrainingError, match="made with batch 16, not 8"):
        fit_with(fit, data, tmp_path / "cut", **settings | {"batch": 8})


def kill_at_step(monkeypatch, count):
    step, steps = torch.optim.AdamW.step, []

    def killed(self, *args, **kwargs):
        steps.append(None)
        if len(steps) == count:
            raise KeyboardInterrupt
        return step(self, *args, **kwargs)

    monkeypatch.setattr(torch.optim.AdamW, "step", killed)


@pytest.mark.parametrize(("fit", "stem"), [(fit_forecaster, "paths"), (fit_eta, "arrivals")])
def test_data_of_another_scene_or_without_description_is_named(data, tmp_path, fit, stem):
    describe(data, stem, digest="0123")
    with pytest.raises(InputError, match=f"{stem}-0.json' is of scene 0123, but the scene is"):
        fit_with(fit, data, tmp_path)
    (data / f"{stem}-0.json").write_text("{")
    with pytest.raises(InputError, match=f"{stem}-0.json' is no JSON file"):
        fit_with(fit, data, tmp_path)
    (data / f"{stem}-0.json").unlink()
    with pytest.raises(InputError, match=f"no {stem}-.*did not finish"):
        fit_with(fit, data, tmp_path)


def test_loss_forgives_the_place_of_a_lost_target_but_not_its_height():
    network = Forecaster(SMALL)
    history = torch.zeros(1, 24, 3) + 0.01 * torch.arange(24.0).view(1, -1, 1) * torch.tensor([1.0, 0.0, 0.0])
    with torch.no_grad():
        future = network.unreflected(history)
    recorded = torch.arange(300).unsqueeze(0) < 100
    windows = Windows(history, torch.tensor([24]), future, recorded, torch.tensor([True]), torch.tensor([True]))
    assert line_loss(network, windows, control_step=0.004) < 1e-4
    moved = future.clone()
    moved[:, 100:, :2] += 1.0
    assert line_loss(network, windows._replace(future=moved), control_step=0.004) < 1e-4
    moved[:, 99, 0] += 1.0
    assert line_loss(network, windows._replace(future=moved), control_step=0.004) > 1e-3
    sunk = future - torch.tensor([0.0, 0.0, 0.1])
    assert line_loss(network, windows._replace(future=sunk), control_step=0.004).item() == pytest.approx(1.0, abs=1e-3)


def test_a_task_without_networks_is_named(data, tmp_path):
    with pytest.raises(InputError, match="trapper has no networks to fit"):
        fit_forecaster(replace(TASK, fitting=None), data, tmp_path)


def test_arrivals_of_another_robot_are_named(data, tmp_path):
    with pytest.raises(InputError, match=r"robot_state of the arrivals must have shape \(\*B, 12\), got"):
        fit_with(fit_eta, data, tmp_path, config=ETAConfig(robot_state_size=12, tool_slice=(9, 12)))
