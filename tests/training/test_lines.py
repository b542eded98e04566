import pytest
import torch

from tests.training.rolling import EXTENT, rolling_line
from torchdyn_plan.nets.reflection import reflect
from torchdyn_plan.training.lines import unreflect_paths


def laid_end_to_end(lines):
    path = torch.cat([reflect(lines[..., :2], EXTENT), lines[..., 2:]], dim=-1)
    start = torch.arange(len(lines)) * lines.shape[1]
    return path.flatten(0, 1), start


def test_undoes_what_mirrors_do():
    line = rolling_line()
    track = unreflect_paths(*laid_end_to_end(line), EXTENT).track.view_as(line)
    bounces = (line[..., :2].abs() / EXTENT).amax().item() / 2
    assert bounces > 2
    # A turning point that is sampled past its bounce counts as before it: one sample, by less than a step.
    torch.testing.assert_close(track, line, atol=0.015, rtol=0)
    assert ((track - line).abs() > 1e-9).double().mean() < 0.005


def test_reflecting_the_line_gives_the_path_back():
    path, start = laid_end_to_end(rolling_line(seed=3))
    track = unreflect_paths(path, start, EXTENT).track
    torch.testing.assert_close(reflect(track[:, :2], EXTENT), path[:, :2])
    assert torch.equal(track[:, 2], path[:, 2])


def test_any_sample_sees_the_line_go_on_from_itself():
    path, start = laid_end_to_end(rolling_line())
    lines = unreflect_paths(path, start, EXTENT)
    torch.testing.assert_close((lines.track[:, :2] - lines.shift) * lines.side, path[:, :2])


def test_a_dwell_in_a_soft_cushion_is_one_bounce():
    x = torch.tensor([0.60, 0.65, 0.70, 0.712, 0.712, 0.705, 0.69, 0.65, 0.60])
    path = torch.stack([x, torch.zeros(9), torch.zeros(9)], dim=-1)
    track = unreflect_paths(path, torch.tensor([0]), 0.7).track
    expected = torch.tensor([0.60, 0.65, 0.70, 0.70, 0.70, 0.70, 0.71, 0.75, 0.80])
    torch.testing.assert_close(track[:, 0], expected)


@pytest.mark.parametrize(
    "x",
    [[0.1, 0.2, 0.3, 0.2, 0.1], [0.68, 0.67, 0.66, 0.67, 0.68]],
    ids=["away from cushions", "turning back towards a cushion"],
)
def test_other_reversals_stay_in_the_line(x):
    x = torch.tensor(x)
    path = torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], dim=-1)
    assert torch.equal(unreflect_paths(path, torch.tensor([0]), 0.7).track, path)


def test_open_space_has_no_line_but_the_path():
    path, start = laid_end_to_end(rolling_line())
    lines = unreflect_paths(path, start, None)
    assert torch.equal(lines.track, path)
    assert not lines.shift.any()
