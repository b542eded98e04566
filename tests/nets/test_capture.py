import copy

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import CaptureNetwork, FunctionCapture

SMALL = {"window": 3, "stride": 2, "hidden": 8, "reach": 0.5}


def network(**settings):
    torch.manual_seed(0)
    return CaptureNetwork(**(SMALL | settings)).double()


def passing(*batch, steps=20, count=4, seed=0):
    """Straight paths (*batch, steps + 1, 3), goals on them (*batch, count, 3), and when the target comes there."""
    draw = torch.Generator().manual_seed(seed)
    start, speed = torch.rand(2, *batch, 1, 3, generator=draw, dtype=torch.float64) - 0.5
    path = start + 0.1 * speed * torch.arange(steps + 1.0, dtype=torch.float64).unsqueeze(-1)
    when = torch.randint(0, steps + 1, (*batch, count), generator=draw)
    return path, path.gather(-2, when.unsqueeze(-1).expand(*when.shape, 3)), when


def test_windows_are_the_path_about_the_meeting():
    path, _, when = passing(2)
    found = network().windows(path, when)
    assert found.shape == (2, 4, 4, 2)
    for row in range(2):
        for k, step in enumerate(when[row].tolist()):
            for j, about in enumerate((-3, -1, 1, 3)):
                expected = path[row, min(max(step + about, 0), 20), :2]
                assert torch.equal(found[row, k, j], expected)


def test_a_batch_is_its_rows():
    path, goal, when = passing(3, 2)
    whole = network().probability(path, goal, when)
    assert whole.shape == (3, 2, 4)
    assert bool(((whole > 0) & (whole < 1)).all())
    for i in range(3):
        for j in range(2):
            torch.testing.assert_close(network().probability(path[i, j], goal[i, j], when[i, j]), whole[i, j])


def test_steps_without_batch_serve_all_rows():
    path, goal, _ = passing(5)
    steps = torch.tensor([1, 4, 9, 16])
    model = network()
    assert torch.equal(model.probability(path, goal, steps), model.probability(path, goal, steps.expand(5, 4)))


@pytest.mark.parametrize("mirrored", [True, False])
def test_a_mirrored_scene_has_mirrored_captures(mirrored):
    model, mirror = network(mirrored=mirrored), torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    path, goal, when = passing(6)
    same = torch.allclose(model.probability(path, goal, when), model.probability(path * mirror, goal * mirror, when))
    assert same == mirrored


def test_what_is_far_away_does_not_matter():
    window, goal = torch.full((1, 4, 2), 0.7, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
    assert torch.equal(network()(window, goal), network()(3.0 * window, goal))
    assert not torch.equal(network()(window, goal), network()(0.5 * window, goal))


def test_heights_are_not_read():
    path, goal, when = passing(2)
    high = path + torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert torch.equal(network().probability(path, goal, when), network().probability(high, goal[..., :2], when))


def test_gradients_reach_path_and_goal():
    path, goal, when = passing(1, steps=6, count=2)
    model = network(mirrored=True)
    assert torch.autograd.gradcheck(
        lambda path, goal: model.probability(path, goal, when), (path.requires_grad_(), goal.requires_grad_())
    )


def test_half_precision_keeps_the_geometry():
    path, goal, when = passing(50)
    exact = network().probability(path, goal, when)
    half = copy.deepcopy(network()).bfloat16().probability(path.float(), goal.float(), when)
    assert half.dtype == torch.float32
    torch.testing.assert_close(half.double(), exact, atol=5e-3, rtol=0)


def test_it_survives_its_file(tmp_path):
    model = network(mirrored=True).float()
    again = CaptureNetwork.from_pretrained(model.save_pretrained(tmp_path))
    assert again.config == model.config
    path, goal, when = (value.float() if value.is_floating_point() else value for value in passing(2))
    assert torch.equal(again.probability(path, goal, when), model.probability(path, goal, when))


def test_a_function_is_a_model():
    path, goal, when = passing(2)
    model = FunctionCapture.wrap(lambda path, goal, steps: steps.expand(goal.shape[:-1]) / 20.0)
    assert torch.equal(model.probability(path, goal, when), when / 20.0)
    assert FunctionCapture.wrap(model) is model


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: FunctionCapture.wrap(0.5), r"capture must be a CaptureModel or a function .* got 0.5"),
        (lambda: CaptureNetwork(window=0), r"window must be .* got 0"),
        (lambda: CaptureNetwork(reach=-1.0), r"reach must be .* got -1"),
        (lambda: CaptureNetwork(mirrored=1), r"mirrored must be True or False, got 1"),
        (lambda: network()(torch.zeros(2, 5, 2).double(), torch.zeros(2, 2).double()), r"window .*4, 2.*5, 2"),
        (lambda: network().windows(torch.zeros(2, 9, 3), torch.zeros(3, 4, dtype=torch.int64)), r"steps .*3, 4"),
        (lambda: network()(torch.full((4, 2), torch.nan).double(), torch.zeros(2).double()), r"window .*NaN"),
    ],
)
def test_bad_input_is_named(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


def test_inputs_are_standardised_by_samples():
    path, goal, when = passing(200, count=1)
    model = network(mirrored=True)
    window = model.windows(path, when).squeeze(1)
    model.set_input_statistics(window, goal[:, 0, :2])
    given = torch.addcmul(model.shift, model._features(window, goal[:, 0, :2]), model.scale)
    torch.testing.assert_close(given.mean(0), torch.zeros(10, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(given.std(0), torch.ones(10, dtype=torch.float64))


@pytest.mark.parametrize("mirrored", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_for_inference_it_is_the_same_function(mirrored, dtype):
    model = network(mirrored=mirrored)
    path, goal, when = passing(3, 2)
    model.set_input_statistics(model.windows(path, when).flatten(0, 2), goal[..., :2].flatten(0, 2))
    fast, expected = model.for_inference().to(dtype), model.probability(path, goal, when)
    given = (path.to(dtype), goal.to(dtype), when)
    torch.testing.assert_close(fast.probability(*given), expected.to(dtype))
    assert all(torch.equal(a, b.to(dtype)) for a, b in zip(given[:2], (path, goal), strict=True))
    other = torch.float32 if dtype == torch.float64 else torch.float64
    found = fast.probability(path.to(other), goal.to(other), when)
    assert found.dtype == other
    torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        fast.probability(path[0, 0].to(dtype), goal[0, 0].to(dtype), when[0, 0]), expected[0, 0].to(dtype)
    )
