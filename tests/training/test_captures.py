"""Attempts at a capture: how they are recorded, read and learned from."""

import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.training.toy_task import CAPTURES, TASK
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import CaptureNetwork
from torchdyn_plan.training.capture_data import Attempts, Captures, Guessing, load_captures
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.fit import fit_capture
from torchdyn_plan.training.metrics import capture_errors
from torchdyn_plan.training.train import train

SMALL = {"steps": 150, "batch": 64, "lr": 2e-2}


@pytest.fixture
def data(tmp_path):
    collect(TASK, "captures", tmp_path, episodes=400, num_envs=100)
    return tmp_path


def attempts(count):
    return Attempts(CAPTURES, count, torch.Generator().manual_seed(0))


def rows(*chosen, count=3):
    return torch.tensor([number in chosen for number in range(count)])


def test_an_attempt_counts_if_the_robot_was_there_in_time():
    kept, far, here = attempts(3), torch.ones(3, 3), torch.zeros(3, 3)
    window = torch.arange(3.0).view(3, 1, 1).expand(3, CAPTURES.positions, 2)
    kept.renew(rows(0, 1, 2), window, here)
    # Row 0 is there early, but not when the target comes; row 1 in time; row 2 never.
    kept.watch(torch.stack([here[0], far[1], far[2]]), torch.full((3,), 20))
    kept.watch(torch.stack([far[0], here[1], far[2]]), torch.full((3,), 3))
    kept.end(rows(0, 1, 2), captured=True)
    seen, goal, captured, row = kept.found(first=10)
    assert row.tolist() == [11]
    assert captured.tolist() == [True]
    assert torch.equal(seen, window[1:2])
    assert torch.equal(goal, here[1:2, :2])
    kept.end(rows(0, 1, 2), captured=False)
    assert len(kept.found().run) == 1


def test_a_new_plan_replaces_an_attempt_and_its_time():
    kept, here = attempts(3), torch.zeros(3, 3)
    window = torch.zeros(3, CAPTURES.positions, 2)
    kept.renew(rows(0), window, here)
    kept.watch(here, torch.zeros(3))
    assert kept.past.tolist() == [1, 0, 0]
    kept.renew(rows(0), window + 1.0, here + 5.0)
    assert kept.past.tolist() == [0, 0, 0]
    kept.end(rows(0), captured=True)
    assert not len(kept.found().run)
    kept.renew(rows(0), window + 2.0, here)
    kept.watch(here, torch.zeros(3))
    kept.drop(rows(0))
    kept.end(rows(0), captured=True)
    assert not len(kept.found().run)


def test_an_explorer_draws_anew_within_its_bounds():
    model, goal = Guessing(torch.Generator().manual_seed(1), least=0.4), torch.zeros(500, 4, 3)
    one, other = (model.probability(goal, goal, torch.zeros(4)) for _ in range(2))
    assert one.shape == (500, 4)
    assert 0.4 <= float(one.min()) < 0.41
    assert 0.99 < float(one.max()) <= 1.0
    assert not torch.equal(one, other)


def test_collected_captures_are_learned_from(data, tmp_path):
    file = train(TASK, "capture", data, tmp_path / "out", **SMALL)
    network = CaptureNetwork.from_pretrained(tmp_path / "out")
    assert network.config == CAPTURES
    rows = json.loads((file.parent / "scores.json").read_text())["Held-out attempts"]
    assert rows[0]["attempts"] == "all"
    assert rows[0]["count"] == 40
    assert rows[0]["ranked"] > 0.95
    assert rows[0]["loss"] < 0.4
    assert "train capture --task toy --static straight --steps 150" in file.with_suffix(".md").read_text()


def test_data_of_another_static_planner_is_refused(data, tmp_path):
    with pytest.raises(InputError, match="is of straight, not of learned"):
        train(TASK, "capture", data, tmp_path / "out", static="learned", **SMALL)


def test_attempts_that_all_ended_alike_teach_nothing(tmp_path):
    collect(TASK, "captures", tmp_path, episodes=20, static="learned")
    with pytest.raises(InputError, match="all ended alike: there is nothing to learn from 20"):
        load_captures(tmp_path, CAPTURES)


def test_a_task_without_such_a_network_says_so(data, tmp_path):
    other = replace(TASK, fitting=lambda: replace(TASK.fitting(), capture=None))
    with pytest.raises(InputError, match="toy has no network of captures to fit"):
        fit_capture(other, data, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("window", lambda value: value[:, 1:], r"window of the captures .*5, 2.*4, 2"),
        ("captured", lambda value: value.long(), r"captured of the captures in .* must be torch.bool, got torch.int64"),
        ("run", lambda value: value[1:], r"have 20 rows of window, 19 of run"),
        ("goal", lambda value: value.index_fill(0, torch.tensor([3]), torch.nan), r"goal of the captures .*NaN"),
    ],
)
def test_damaged_captures_are_named(tmp_path, name, change, message):
    collect(TASK, "captures", tmp_path, episodes=20)
    file = tmp_path / "captures-0-000.safetensors"
    tensors = load_file(file)
    save_file(tensors | {name: change(tensors[name]).contiguous()}, file)
    with pytest.raises(InputError, match=message):
        load_captures(tmp_path, CAPTURES)


def test_scores_by_hand():
    speed = torch.tensor([0.0, 0.001, 0.03, 0.03])
    window = speed.view(4, 1, 1) * torch.arange(3.0).view(1, 3, 1) * torch.tensor([2.0, 0.0])
    held = Captures(window, torch.zeros(4, 2), torch.tensor([True, False, True, False]), torch.arange(4))
    logits = torch.tensor([0.0, 0.0, 1.0, 2.0])
    whole, slow, *empty, fast = capture_errors(logits, held, stride=2)
    assert (whole["count"], slow["count"], fast["count"]) == (4, 2, 2)
    assert [row["loss"] for row in empty] == [None, None]
    assert whole["captured"] == slow["captured"] == 0.5
    assert slow["loss"] == pytest.approx(0.6931, abs=1e-4)
    assert slow["ranked"] == 0.5
    assert fast["ranked"] == 0.0
    assert whole["ranked"] == pytest.approx((0.5 + 0.0 + 1.0 + 0.0) / 4)
