"""DDPG with hindsight, and its averaged form: they learn, resume exactly, keep the best, refuse what does not fit."""

import csv
import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from tests.scripts import CONTEXT
from tests.training.points import PointTask
from torchdyn_plan.errors import InputError, TrainingError
from torchdyn_plan.nets.policy import Actor
from torchdyn_plan.stopping import Terminated, terminable
from torchdyn_plan.training import checkpoint
from torchdyn_plan.training.algorithms import ALGORITHMS, learner_type, recipe_for
from torchdyn_plan.training.averaged import AveragedDDPG, AveragedRecipe
from torchdyn_plan.training.ddpg import DDPG
from torchdyn_plan.training.goal_task import DDPGRecipe
from torchdyn_plan.training.policy import fit_policy

RECIPE = DDPGRecipe(iterations=12, num_envs=8, updates=20, batch=64, capacity=500, warmup=2, gamma=0.9)
RECIPES = {"ddpg": RECIPE, "averaged": AveragedRecipe.like(RECIPE)}
RECIPES["averaged"] = replace(RECIPES["averaged"], iterations=12, gamma=0.9)


SHORT = replace(RECIPE, iterations=2, updates=2, warmup=1)


class CutError(Exception):
    """A stand-in for a crash."""


class CutTask(PointTask):
    """Crashes at its n-th score."""

    def __init__(self, scores: int) -> None:
        self.left = scores

    def score(self, actor: Actor) -> dict[str, float]:
        self.left -= 1
        if self.left < 0:
            raise CutError
        return super().score(actor)


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return Actor.from_pretrained(folder / "policy").state_dict()


@pytest.mark.parametrize("kind", [DDPGRecipe, pytest.param(AveragedRecipe, marks=pytest.mark.slow)])
def test_learns_to_reach(kind: type[DDPGRecipe], tmp_path: Path) -> None:
    recipe = kind(iterations=30, num_envs=16, updates=30, batch=128, capacity=20_000, warmup=2, gamma=0.9)
    fit_policy(PointTask(), tmp_path, recipe=recipe, score_every=10)
    with (tmp_path / "policy" / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["round"] for row in rows] == ["10", "20", "30"]
    assert float(rows[-1]["success"]) > 0.9
    untrained = PointTask().score(Actor(PointTask.policy_config))["success"]
    assert untrained < 0.3
    assert "success" in (tmp_path / "policy" / "policy.md").read_text()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_interrupted_training_ends_where_an_undisturbed_one_does(algorithm: str, tmp_path: Path) -> None:
    recipe = RECIPES[algorithm]
    fit_policy(PointTask(), tmp_path / "whole", recipe=recipe, score_every=2)
    for scores in (1, 2):
        with pytest.raises(CutError):
            fit_policy(CutTask(scores), tmp_path / "cut", recipe=recipe, score_every=2)
    fit_policy(PointTask(), tmp_path / "cut", recipe=recipe, score_every=2)
    whole, cut = weights(tmp_path / "whole"), weights(tmp_path / "cut")
    assert all(torch.equal(value, cut[name]) for name, value in whole.items())
    curves = []
    for folder in ("whole", "cut"):
        with (tmp_path / folder / "policy" / "curve.csv").open() as file:
            curves.append([{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)])
    assert curves[0] == curves[1]
    one, other = (load_file(tmp_path / name / "policy" / "checkpoint.safetensors") for name in ("whole", "cut"))
    assert one.keys() == other.keys()
    assert all(torch.equal(value, other[name]) for name, value in one.items())


def train(folder: Path, recipe: DDPGRecipe) -> None:
    torch.set_num_threads(1)
    fit_policy(PointTask(), folder, recipe=recipe, score_every=2)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_killed_training_resumes(algorithm: str, tmp_path: Path) -> None:
    """A real process, killed with SIGKILL when it has written a checkpoint, leaves a folder that goes on exactly."""
    train(tmp_path / "whole", RECIPES[algorithm])
    process = CONTEXT.Process(target=train, args=(tmp_path / "killed", RECIPES[algorithm]))
    process.start()
    checkpoint = tmp_path / "killed" / "policy" / "checkpoint.safetensors"
    deadline = time.monotonic() + 120
    while not checkpoint.exists() and process.is_alive() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.join()
    assert checkpoint.exists()
    train(tmp_path / "killed", RECIPES[algorithm])
    whole, killed = weights(tmp_path / "whole"), weights(tmp_path / "killed")
    assert all(torch.equal(value, killed[name]) for name, value in whole.items())


def test_the_best_policy_is_kept(tmp_path: Path) -> None:
    class Worse(PointTask):
        scores = iter([0.5, 0.9, 0.2, 0.1, 0.9, 0.3])

        def score(self, actor: Actor) -> dict[str, float]:
            kept.append({name: value.clone() for name, value in actor.state_dict().items()})
            return {"success": next(self.scores), "steps": 0.0}

    kept: list[dict[str, torch.Tensor]] = []
    fit_policy(Worse(), tmp_path, recipe=RECIPE, score_every=2)
    best = weights(tmp_path)
    assert all(torch.equal(value, best[name]) for name, value in kept[4].items())


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_nan_stops_and_leaves_the_last_checkpoint(algorithm: str, tmp_path: Path) -> None:
    class Broken(PointTask):
        rounds = 0

        def reward(self, transitions: object) -> torch.Tensor:
            value = super().reward(transitions)
            Broken.rounds += 1
            return value * float("nan") if Broken.rounds > 100 else value

    with pytest.raises(TrainingError, match=r"round 8, update 1: loss of the actor .*critic nan.*checkpoint is kept"):
        fit_policy(Broken(), tmp_path, recipe=RECIPES[algorithm], score_every=2)
    fit_policy(PointTask(), tmp_path, recipe=RECIPES[algorithm], score_every=2)


def test_refuses_another_configuration_before_anything_is_written(tmp_path: Path) -> None:
    short = DDPGRecipe(iterations=2, num_envs=8, updates=2, batch=64, capacity=500, warmup=1, gamma=0.9)
    fit_policy(PointTask(), tmp_path, recipe=short, score_every=1)
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "policy").iterdir()}
    other = DDPGRecipe(iterations=2, num_envs=8, updates=2, batch=32, capacity=500, warmup=1, gamma=0.9)
    with pytest.raises(TrainingError, match=r"made with recipe .*'batch': 64"):
        fit_policy(PointTask(), tmp_path, recipe=other, score_every=1)

    faster = AveragedRecipe(iterations=2, num_envs=8, updates=2, batch=64, capacity=500, warmup=1, gamma=0.9)
    with pytest.raises(TrainingError, match="made with algorithm 'ddpg', not 'averaged'"):
        fit_policy(PointTask(), tmp_path, recipe=faster, score_every=1)

    class Other(PointTask):
        def settings(self) -> dict[str, str]:
            return {"task": "squares"}

    with pytest.raises(TrainingError, match="made with task 'points', not 'squares'"):
        fit_policy(Other(), tmp_path, recipe=short, score_every=1)
    assert before == {file: file.stat().st_mtime_ns for file in (tmp_path / "policy").iterdir()}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("trained")
    fit_policy(PointTask(), folder, recipe=SHORT, score_every=1)
    return (folder / "policy" / "checkpoint.safetensors").read_bytes()


def signed(file: Path, tensors: dict[str, torch.Tensor], **changes: str) -> None:
    """Write the checkpoint as somebody would who knows how: its digest fits."""
    with safe_open(file, framework="pt") as content:
        metadata = content.metadata() | changes
    save_file(tensors, file, metadata | {"digest": checkpoint._digest(metadata, tensors)})


@pytest.mark.parametrize(
    "progress",
    [{}, None, [], {"ddpg": None}, {"ddpg": {"iteration": 1}}, {"curve": None}, {"best": {"success": None}}],
    ids=str,
)
def test_damaged_progress_is_named(tmp_path: Path, trained: bytes, progress: object) -> None:
    file = tmp_path / "policy" / "checkpoint.safetensors"
    file.parent.mkdir()
    file.write_bytes(trained)
    if progress:
        with safe_open(file, framework="pt") as content:
            assert isinstance(progress, dict)
            progress = json.loads(content.metadata()["progress"]) | progress
    signed(file, load_file(file), progress=json.dumps(progress))
    with pytest.raises(TrainingError, match=r"checkpoint\.safetensors': .*progress"):
        fit_policy(PointTask(), tmp_path, recipe=SHORT, score_every=1)


@pytest.mark.parametrize("prefix", ["best.", "replay.", "optimiser.", "generator", "loss."])
def test_damaged_tensors_are_named(tmp_path: Path, trained: bytes, prefix: str) -> None:
    file = tmp_path / "policy" / "checkpoint.safetensors"
    file.parent.mkdir()
    file.write_bytes(trained)
    tensors = load_file(file)
    cut = {name: value[:1] if name.startswith(prefix) and value.ndim else value for name, value in tensors.items()}
    save_file(cut, file, safe_open(file, framework="pt").metadata())
    with pytest.raises(TrainingError, match=r"checkpoint\.safetensors' differs from what was written"):
        fit_policy(PointTask(), tmp_path, recipe=SHORT, score_every=1)


def test_a_full_disk_for_the_log_is_no_reason_to_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tensorboard = pytest.importorskip("torch.utils.tensorboard")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tensorboard.SummaryWriter, "add_scalar", full)
    assert fit_policy(PointTask(), tmp_path, recipe=SHORT, score_every=1).is_file()


def test_a_signal_saves_the_round_that_is_going_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = replace(SHORT, iterations=4)
    fit_policy(PointTask(), tmp_path / "whole", recipe=recipe, score_every=4)
    collect = DDPG.collect

    def told(self: DDPG) -> dict[str, float]:
        if self.iteration == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return collect(self)

    with monkeypatch.context() as patch:
        patch.setattr(DDPG, "collect", told)
        with pytest.raises(Terminated), terminable():
            fit_policy(PointTask(), tmp_path / "cut", recipe=recipe, score_every=4)
    fit_policy(PointTask(), tmp_path / "cut", recipe=recipe, score_every=4)
    whole, cut = weights(tmp_path / "whole"), weights(tmp_path / "cut")
    assert all(torch.equal(value, cut[name]) for name, value in whole.items())


@pytest.mark.parametrize(("name", "value"), [("num_envs", 0), ("gamma", 1.5), ("noise", -0.1), ("lr_actor", 0.0)])
def test_refuses_impossible_recipes(name: str, value: float) -> None:
    with pytest.raises(InputError, match=name):
        DDPGRecipe(**{name: value})


def test_targets_follow_and_statistics_reach_every_network() -> None:
    ddpg = DDPG(PointTask(), RECIPE)
    for _ in range(3):
        ddpg.iterate()
    shift = ddpg.actor.features.shift
    assert shift.abs().sum() > 0
    assert torch.equal(ddpg.critic.features.shift, shift)
    for parameters in (ddpg.loss.target_actor_network_params, ddpg.loss.target_value_network_params):
        assert torch.equal(parameters["module", "features", "shift"].data, shift)
    target = ddpg.loss.target_actor_network_params["module", "body", "0", "weight"].data
    online = ddpg.actor.body[0].weight
    assert 0 < (target - online).abs().max() < 0.1


@pytest.mark.parametrize(("name", "value"), [("delay", 0), ("average", 0.0), ("average", 1.5), ("gamma", 2.0)])
def test_refuses_impossible_averages(name: str, value: float) -> None:
    with pytest.raises(InputError, match=name):
        AveragedRecipe(**{name: value})


def test_a_recipe_is_carried_over_to_another_algorithm() -> None:
    of_task = DDPGRecipe(num_envs=7, capacity=900, clip_return=True, seed=3, gamma=0.5, iterations=11)
    averaged = recipe_for("averaged", of_task)
    assert (averaged.num_envs, averaged.capacity, averaged.clip_return, averaged.seed) == (7, 900, True, 3)
    assert (averaged.gamma, averaged.iterations) == (AveragedRecipe().gamma, AveragedRecipe().iterations)
    assert recipe_for("ddpg", averaged) == replace(
        of_task, gamma=DDPGRecipe().gamma, iterations=DDPGRecipe().iterations
    )
    assert recipe_for("ddpg", of_task) is of_task
    with pytest.raises(InputError, match=r"unknown algorithm 'avereged' \(did you mean 'averaged'\?\)"):
        recipe_for("avereged", of_task)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_algorithm_learns_by_recipes_of_its_name(algorithm: str) -> None:
    learner = learner_type(algorithm)(PointTask(), recipe_for(algorithm, RECIPE))
    assert learner.recipe.algorithm == algorithm
    learner.close()


def test_the_actor_waits_and_its_average_lags_behind_it() -> None:
    learner = AveragedDDPG(PointTask(), replace(RECIPES["averaged"], delay=3, average=0.25, tau=0.5))
    for _ in range(2):
        learner.iterate()
    learner.standardise()
    shift = learner.actor.features.shift
    assert shift.abs().sum() > 0
    assert all(torch.equal(network.features.shift, shift) for network in learner.networks.values())

    def weight(network: torch.nn.Module) -> torch.Tensor:
        return network.body[0].weight.detach().clone()

    for number in range(4):
        before = {name: weight(network) for name, network in learner.networks.items()}
        learner.update(learner.replay.sample(), number)
        after = {name: weight(network) for name, network in learner.networks.items()}
        assert not torch.equal(before["critic"], after["critic"])
        assert torch.equal(before["actor"], after["actor"]) == (number % 3 != 0)
        for name, leader, share in (("average", "actor", 0.25), ("target_critic", "critic", 0.5)):
            torch.testing.assert_close(after[name], torch.lerp(before[name], after[leader], share))
    assert learner.learned is learner.average


def test_values_are_targets_discounted_and_stop_where_an_episode_does() -> None:
    learner = AveragedDDPG(PointTask(), RECIPES["averaged"])
    for _ in range(2):
        learner.iterate()
    batch = learner.replay.sample()
    batch["next", "terminated"][::2] = True
    targets = learner.value_targets(batch)
    assert torch.equal(targets[::2], batch["next", "reward"][::2])
    after = batch["next"]
    for row in (1, 3, 5):
        state, goal = after["observation"][row], after["desired_goal"][row]
        value = learner.target_critic(state, goal, learner.target_actor(state, goal))
        torch.testing.assert_close(targets[row], after["reward"][row] + 0.9 * value)
    bounded = AveragedDDPG(PointTask(), replace(RECIPES["averaged"], clip_return=True))
    batch["next", "reward"][:] = -100.0
    assert (bounded.value_targets(batch) == -1.0 / (1.0 - 0.9)).all()


def test_the_precision_of_products_is_as_it_was_after_a_round() -> None:
    before = torch.get_float32_matmul_precision()
    learner = AveragedDDPG(PointTask(), RECIPES["averaged"])
    for _ in range(3):
        learner.iterate()
    assert torch.get_float32_matmul_precision() == before
