import json
import math
import os
import random
import signal

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from torchdyn_plan.errors import InputError, TrainingError
from torchdyn_plan.stopping import terminable
from torchdyn_plan.training import checkpoint
from torchdyn_plan.training.optimise import Recipe, optimise


def fit(out, *, steps=40, fail_at=None, nan_at=None, resume=True, settings=None, **recipe):
    """Fit a line; ``fail_at`` kills the run as a signal would, ``nan_at`` gives a NaN loss, each at that step."""
    torch.manual_seed(0)
    network, calls = nn.Linear(3, 1), []

    def loss(generator):
        calls.append(None)
        if len(calls) == fail_at:
            raise KeyboardInterrupt
        x = torch.randn(16, 3, generator=generator)
        error = (network(x) - x.sum(-1, keepdim=True) - 1.0).square().mean()
        return error * float("nan") if len(calls) == nan_at else error

    def validate():
        return {"slope_error": float((network.weight - 1.0).abs().max())}

    recipe = Recipe(**{"steps": steps, "batch": 16, "lr": 0.1, "validations": 4, "checkpoint_seconds": 0.0} | recipe)
    curve = optimise(network, loss, validate, recipe, out=out, settings=settings or {"width": 3}, resume=resume)
    return network, curve, len(calls)


def test_it_learns_and_records(tmp_path):
    network, curve, _ = fit(tmp_path, steps=400, checkpoint_seconds=60.0)
    torch.testing.assert_close(network.weight, torch.ones(1, 3), atol=1e-2, rtol=0)
    assert [entry["step"] for entry in curve] == [100, 200, 300, 400]
    assert curve[-1]["loss"] < 1e-3 < curve[0]["loss"]
    assert json.loads((tmp_path / "curve.json").read_text()) == curve
    assert set(curve[0]) == {"step", "loss", "lr", "slope_error"}


@pytest.mark.parametrize("fail_at", [1, 2, 17, 33])
def test_an_interrupted_fit_ends_bit_identical(tmp_path, fail_at):
    whole, whole_curve, _ = fit(tmp_path / "whole", checkpoint_seconds=60.0)
    with pytest.raises(KeyboardInterrupt):
        fit(tmp_path / "cut", fail_at=fail_at)
    rest, rest_curve, calls = fit(tmp_path / "cut")
    assert calls == 40 - (fail_at - 1)
    assert torch.equal(rest.weight, whole.weight)
    assert rest_curve == whole_curve
    one, other = (load_file(tmp_path / name / "checkpoint.safetensors") for name in ("whole", "cut"))
    assert one.keys() == other.keys()
    assert {"generator", "network.weight", "optimiser.0.exp_avg", "optimiser.1.step"} <= one.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_a_finished_fit_is_not_repeated_and_one_without_resume_starts_over(tmp_path):
    network, curve, _ = fit(tmp_path)
    again, same, calls = fit(tmp_path)
    assert (calls, same) == (0, curve)
    assert torch.equal(again.weight, network.weight)
    fresh, same, calls = fit(tmp_path, resume=False)
    assert (calls, same) == (40, curve)
    assert torch.equal(fresh.weight, network.weight)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lr": 0.2}, "made with lr 0.1, not 0.2"),
        ({"steps": 50}, "made with steps 40, not 50"),
        ({"seed": 5}, "made with seed 0, not 5"),
        ({"settings": {"width": 4}}, "made with width 3, not 4"),
        ({"settings": {"width": 3, "depth": 1}}, "made with depth None, not 1"),
    ],
)
def test_other_settings_are_named(tmp_path, change, message):
    fit(tmp_path)
    with pytest.raises(TrainingError, match=message):
        fit(tmp_path, **change)


def test_a_nan_stops_the_fit_and_keeps_the_checkpoint(tmp_path):
    with pytest.raises(TrainingError, match=r"step 15 has loss nan.*checkpoint\.safetensors.* is kept"):
        fit(tmp_path, nan_at=15)
    kept = load_file(tmp_path / "checkpoint.safetensors")
    assert all(tensor.isfinite().all() for tensor in kept.values())
    whole, _, _ = fit(tmp_path / "whole")
    rest, _, calls = fit(tmp_path)
    assert calls == 26
    assert torch.equal(rest.weight, whole.weight)


def test_a_nan_at_once_says_that_nothing_is_kept(tmp_path):
    with pytest.raises(TrainingError, match=r"step 1 has loss nan.*there is no checkpoint yet"):
        fit(tmp_path, nan_at=1)


@pytest.mark.parametrize("kept", [0, 40, -3])
def test_a_damaged_checkpoint_is_named(tmp_path, kept):
    fit(tmp_path)
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(TrainingError, match=r"damaged checkpoint: .*checkpoint\.safetensors' is not.*without resume"):
        fit(tmp_path)
    fit(tmp_path, resume=False)


def test_rate_rises_and_falls_to_zero():
    recipe = Recipe(steps=100, batch=1, lr=0.5, warmup_share=0.1)
    rates = [recipe.rate(step) for step in range(100)]
    assert max(rates) == rates[9] == 0.5
    assert rates[:10] == sorted(rates[:10])
    assert rates[9:] == sorted(rates[9:], reverse=True)
    assert rates[-1] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("change", [{"steps": 0}, {"batch": 1.5}, {"lr": 0.0}, {"seed": -1}, {"device": "gpu"}])
def test_wrong_recipes_are_named(change):
    with pytest.raises(InputError, match=next(iter(change))):
        Recipe(**{"steps": 1, "batch": 1, "lr": 1.0} | change)


def damaged(file, tensors=None, **changes):
    """The checkpoint with other metadata, None for none; its digest is as it was, unless it is told, too."""
    from safetensors import safe_open

    with safe_open(file, framework="pt") as content:
        metadata = content.metadata() | changes
    save_file(tensors or load_file(file), file, {name: value for name, value in metadata.items() if value is not None})


def signed(file, **changes):
    """The same as somebody would write it who knows how: the digest fits."""
    from safetensors import safe_open

    with safe_open(file, framework="pt") as content:
        metadata = content.metadata() | changes
    damaged(file, **changes, digest=checkpoint._digest(metadata, load_file(file)))


WHOLE = {"step": 7, "total": 0.5, "counted": 1, "curve": []}
WRONG = (None, "x", -1, {}, [3], 1.5e400, 2**70, True)
BAD_PROGRESS = [
    *({}, None, [], 3, "text", {"curve": [{"step": None}]}, {"curve": [[1]]}, {"total": math.nan}),
    # A sum of losses may well be -1 or 2^70, and a curve empty.
    *({name: value} for name in WHOLE for value in WRONG if name != "total" or value not in (-1, 2**70)),
]


@pytest.mark.parametrize("change", BAD_PROGRESS, ids=str)
@pytest.mark.parametrize("write", [damaged, signed])
def test_damaged_progress_is_named(tmp_path, change, write, fitted):
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(fitted)
    progress = WHOLE | change if isinstance(change, dict) and change else change
    write(file, progress=json.dumps(progress))
    with pytest.raises(TrainingError, match=r"checkpoint\.safetensors'.*without resume"):
        fit(tmp_path)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fitted")
    fit(folder, steps=40, checkpoint_seconds=60.0)
    return (folder / "checkpoint.safetensors").read_bytes()


@pytest.mark.parametrize(
    "changes",
    [
        {"settings": "null"},
        {"settings": "[]"},
        {"settings": "{"},
        {"settings": None},
        {"progress": None},
        {"digest": None},
        {"digest": "0"},
        {"format": "1"},
        {"settings": "[" * 10**5},
        {"progress": "[" * 10**5},
    ],
    ids=str,
)
def test_damaged_settings_are_named(tmp_path, changes, fitted):
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(fitted)
    damaged(file, **changes)
    with pytest.raises(TrainingError, match=r"checkpoint\.safetensors'.*without resume"):
        fit(tmp_path)


def test_every_flipped_bit_is_found(tmp_path, fitted):
    file = tmp_path / "checkpoint.safetensors"
    draw = random.Random(0)
    for place in draw.sample(range(len(fitted)), 60):
        changed = bytearray(fitted)
        changed[place] ^= 1 << draw.randrange(8)
        file.write_bytes(changed)
        with pytest.raises(TrainingError, match=r"checkpoint\.safetensors'"):
            fit(tmp_path)
    file.write_bytes(fitted)
    assert fit(tmp_path)[2] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_the_step_that_is_going_on(tmp_path, number, monkeypatch):
    """No time between checkpoints has passed, and none is lost."""
    whole, whole_curve, _ = fit(tmp_path / "whole", checkpoint_seconds=3600.0)
    step = torch.optim.AdamW.step
    steps = []

    def told(self, *args, **kwargs):
        steps.append(None)
        if len(steps) == 17:
            os.kill(os.getpid(), number)
        return step(self, *args, **kwargs)

    monkeypatch.setattr(torch.optim.AdamW, "step", told)
    # In the background of a shell Ctrl-C is ignored.
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), terminable():
            fit(tmp_path / "cut", checkpoint_seconds=3600.0)
    finally:
        signal.signal(signal.SIGINT, former)
    rest, rest_curve, calls = fit(tmp_path / "cut", checkpoint_seconds=3600.0)
    assert calls == 40 - 17
    assert torch.equal(rest.weight, whole.weight)
    assert rest_curve == whole_curve
