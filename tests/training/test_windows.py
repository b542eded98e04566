import pytest
import torch

from tests.training.rolling import EXTENT, write_paths
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.reflection import reflect
from torchdyn_plan.training.lines import unreflect_paths
from torchdyn_plan.training.windows import (
    WindowConfig,
    cut_windows,
    draw_windows,
    last_useful_step,
    load_paths,
    read_shards,
)

CONFIG = WindowConfig(horizon=50)


@pytest.fixture
def paths(tmp_path):
    write_paths(tmp_path)
    return load_paths(tmp_path)


def test_a_window_by_hand(paths):
    windows = cut_windows(paths, torch.tensor([2]), torch.tensor([30]), torch.tensor([24]), CONFIG)
    first = int(paths.start[2])
    assert torch.equal(windows.history[0], paths.positions[first + 7 : first + 31])
    assert torch.equal(windows.future[0], paths.positions[first + 31 : first + 81])
    assert (windows.history_length.item(), windows.lost.item(), windows.moving.item()) == (24, False, True)


def test_padding_repeats_the_first_sample(paths):
    windows = cut_windows(paths, torch.tensor([2]), torch.tensor([13]), torch.tensor([13]), CONFIG)
    first = int(paths.start[2])
    assert torch.equal(windows.history[0, 10:], paths.positions[first : first + 14])
    assert torch.equal(windows.history[0, :10], paths.positions[first].expand(10, 3))


def test_a_lost_target_stays_and_is_marked(paths):
    windows = cut_windows(paths, torch.tensor([1, 1]), torch.tensor([180, 40]), torch.tensor([24, 24]), CONFIG)
    assert windows.lost.tolist() == [True, False]
    assert windows.recorded[0].tolist() == [True] * 20 + [False] * 30
    assert torch.equal(windows.future[0, 20:], windows.future[0, 19].expand(30, 3))
    assert windows.recorded[1].all()


def test_unreflected_futures_reflect_to_the_futures(paths):
    lines = unreflect_paths(paths.positions, paths.start, EXTENT)
    last = last_useful_step(paths, CONFIG)
    episodes = torch.arange(12).repeat(40)
    plain, line = (
        draw_windows(paths, last, episodes, CONFIG, torch.Generator().manual_seed(1), lines=given)
        for given in (None, lines)
    )
    assert torch.equal(plain.history, line.history)
    torch.testing.assert_close(reflect(line.future[..., :2], EXTENT), plain.future[..., :2], atol=1e-5, rtol=0)
    step = line.future[..., 0, :2] - line.history[..., -1, :2]
    # However the table lies, the line goes on from where the target is now.
    assert step.abs().max() < 2 * 0.015


def test_draws_stay_within_the_recording(paths):
    last = last_useful_step(paths, CONFIG)
    windows = draw_windows(paths, last, torch.arange(12).repeat(200), CONFIG, torch.Generator().manual_seed(0))
    assert bool((windows.history_length >= 13).all())
    assert windows.recorded[~windows.lost].all()
    assert 0.2 < (windows.history_length < 24).float().mean() < 0.5


def test_data_that_is_missing_or_damaged_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no paths-\*\.safetensors in .*"):
        load_paths(tmp_path)
    write_paths(tmp_path)
    with pytest.raises(InputError, match=r"paths-0-000\.safetensors' lacks speed"):
        read_shards(tmp_path, "paths", ("positions", "speed"))
    file = tmp_path / "paths-0-000.safetensors"
    file.write_bytes(file.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"paths-0-000\.safetensors' is not a whole safetensors file"):
        load_paths(tmp_path)
