"""Any network of any task, by its own recipe but for what is asked for."""

import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

from tests.training.toy_task import TASK, LearnOptions
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError, TrainingError
from torchdyn_plan.nets import Actor, ETANetwork, Forecaster, SpreadNetwork
from torchdyn_plan.tasks import load_task
from torchdyn_plan.training import Recipe, SensorRange, Sighting
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.goal_task import DDPGRecipe
from torchdyn_plan.training.train import networks, train


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    for what in ("paths", "arrivals"):
        collect(TASK, what, folder, episodes=32, num_envs=16, num_threads=1)
    return folder


@pytest.fixture(autouse=True)
def few_rows(monkeypatch):
    monkeypatch.setattr("torchdyn_plan.training.path_data.SCORED", 16)


def test_networks_are_those_that_the_task_has_data_and_recipes_for():
    noisy = ("noisy_forecaster", "noisy_spread")
    assert networks(TASK) == ("forecaster", "spread", *noisy, "eta", "nearest_eta", "capture", "policy")
    assert "capture" not in networks(replace(TASK, record_captures=None))
    assert networks(replace(TASK, record_paths=None)) == networks(TASK)
    assert networks(replace(TASK, fitting=None)) == ("policy",)
    assert networks(load_task("fetch_reach"))[-2:] == ("policy", "dher")


@pytest.mark.parametrize(("network", "kind"), [("forecaster", Forecaster), ("eta", ETANetwork)])
def test_a_network_is_fitted_with_the_sizes_that_the_task_says(data, tmp_path, network, kind):
    file = train(TASK, network, data, tmp_path, steps=3, batch=8, seed=1)
    made = kind.from_pretrained(tmp_path)
    assert made.config == getattr(TASK.fitting(), network)
    on = "" if network in ("forecaster", "spread") else " --static straight"
    assert (
        f"train {network} --task toy{on} --steps 3 --batch 8 --lr 0.002 --seed 1" in file.with_suffix(".md").read_text()
    )
    with pytest.raises(TrainingError, match=r"made with lr 0.002, not 0.1"):
        train(TASK, network, data, tmp_path, steps=3, batch=8, seed=1, lr=0.1)


def test_what_is_not_asked_for_is_as_the_task_says(data, tmp_path):
    fitting = replace(TASK.fitting(), recipes={"eta": Recipe(steps=2, batch=8, lr=0.01, clip=0.5)})
    file = train(replace(TASK, fitting=lambda: fitting), "eta", data, tmp_path, seed=3)
    card = file.with_suffix(".md").read_text()
    assert "steps 2, batch 8, lr 0.01, seed 3" in card
    assert "clip 0.5" in card


def test_a_spread_belongs_to_the_forecaster_beside_it(data, tmp_path):
    train(TASK, "forecaster", data, tmp_path, steps=3, batch=8)
    file = train(TASK, "spread", data, tmp_path, steps=3, batch=8)
    assert f"forecaster: {tmp_path / 'forecaster' / 'forecaster.safetensors'}" in file.with_suffix(".md").read_text()


def test_the_forecaster_that_ships_stands_in_for_a_missing_one(monkeypatch, tmp_path):
    found = []
    monkeypatch.setattr(
        "torchdyn_plan.training.fit_spread.fit_spread", lambda *_, forecaster, **__: found.append(forecaster)
    )
    train("trapper", "spread", tmp_path, tmp_path)
    train("trapper", "noisy_spread", tmp_path, tmp_path)
    assert found == ["trapper", "trapper-noisy"]


def test_networks_for_measured_targets_are_trained_by_sensors_and_a_track(data, tmp_path, monkeypatch):
    monkeypatch.setattr("torchdyn_plan.training.sighted_data.SCORED", 8)
    config = replace(TASK.fitting().forecaster, tracked=True)
    regimes = {"exact": Sensor(), "slow": Sensor(noise=0.001, rate=5.0)}
    sighting = Sighting(passes=1, each=4, steps=25, sensors=SensorRange(slowest=5.0, fastest=10.0), regimes=regimes)
    fitting = replace(TASK.fitting(), noisy_forecaster=config, sighting=sighting)
    task = replace(TASK, fitting=lambda: fitting)
    with pytest.raises(InputError, match="toy has no forecaster for noisy measurements"):
        train(TASK, "noisy_forecaster", data, tmp_path)
    file = train(task, "noisy_forecaster", data, tmp_path, steps=4, batch=8)
    assert file == tmp_path / "noisy_forecaster" / "forecaster.safetensors"
    assert Forecaster.from_pretrained(file).config == config
    assert "train noisy_forecaster --task toy --steps 4" in file.with_suffix(".md").read_text()
    rows = json.loads((file.parent / "scores.json").read_text())["Errors on held-out windows [m]"]
    assert {row["sensor"] for row in rows} == set(regimes)
    again = train(task, "noisy_forecaster", data, tmp_path / "again", steps=4, batch=8)
    one, other = load_file(file), load_file(again)
    assert all(torch.equal(one[name], other[name]) for name in one)
    spread = train(task, "noisy_spread", data, tmp_path, steps=4, batch=8)
    assert SpreadNetwork.from_pretrained(spread).config.tracked
    rows = json.loads((spread.parent / "scores.json").read_text())["Coverage on held-out windows"]
    assert {row["sensor"] for row in rows} == set(regimes)


def test_a_policy_learns_by_the_recipe_of_its_task(tmp_path):
    file = train(TASK, "policy", tmp_path, tmp_path, seed=5, options=LearnOptions(note="twice"))
    assert file == tmp_path / "policy" / "policy.safetensors"
    card = file.with_suffix(".md").read_text()
    assert "iterations 2, num_envs 4" in card
    assert "seed 5" in card
    assert isinstance(Actor.from_pretrained(tmp_path), Actor)
    again = train(TASK, "policy", tmp_path, tmp_path / "again", seed=5)
    one, other = load_file(file), load_file(again)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_a_policy_learns_by_the_algorithm_that_is_named(tmp_path):
    file = train(TASK, "policy", tmp_path, tmp_path, steps=3, algorithm="averaged")
    assert "algorithm: averaged" in file.with_suffix(".md").read_text()
    with pytest.raises(TrainingError, match="made with algorithm 'averaged', not 'ddpg'"):
        train(TASK, "policy", tmp_path, tmp_path, steps=3)


def test_a_learning_rate_is_the_critics_and_the_actors_in_proportion():
    assert (DDPGRecipe().with_rate(3e-4).lr_critic, DDPGRecipe().with_rate(3e-4).lr_actor) == (3e-4, 3e-4 / 2)
    even = DDPGRecipe(lr_actor=1e-3, lr_critic=1e-3).with_rate(3e-4)
    assert (even.lr_critic, even.lr_actor) == (3e-4, 3e-4)


@pytest.mark.parametrize(
    ("network", "settings", "message"),
    [
        ("forcaster", {}, r"unknown network of toy 'forcaster' \(did you mean 'forecaster'\?\)"),
        ("eta", {"num_envs": 4}, "num_envs is for policies only: eta has none, got 4"),
        ("forecaster", {"workers": 2}, "workers is for policies only"),
        ("eta", {"options": LearnOptions()}, "options is for policies only"),
        ("eta", {"algorithm": "ddpg"}, "algorithm is for policies only"),
        ("policy", {"algorithm": "sac"}, "unknown algorithm 'sac'; choose from averaged, ddpg"),
        ("eta", {"steps": 0}, "steps must be >= 1"),
        ("policy", {"options": 3}, "options of policy must be LearnOptions, got int"),
        ("policy", {"steps": 0}, "iterations must be >= 1"),
    ],
)
def test_what_cannot_be_trained_is_named_and_nothing_is_written(data, tmp_path, network, settings, message):
    with pytest.raises(InputError, match=message):
        train(TASK, network, data, tmp_path / "out", **settings)
    assert not (tmp_path / "out").exists()
