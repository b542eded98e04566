import pytest
import torch
from safetensors.torch import save_file

from tests.training.rolling import write_arrivals
from torchdyn_plan.errors import InputError
from torchdyn_plan.training.arrival_data import load_arrivals, split_groups


@pytest.mark.parametrize("seed", [0, 1])
def test_groups_are_held_out_whole(seed):
    group = torch.randint(50, (1000,), generator=torch.Generator().manual_seed(7)) * 3
    train, held = split_groups(group, seed)
    assert torch.equal(torch.cat([train, held]).sort().values, torch.arange(1000))
    assert not set(group[train].tolist()) & set(group[held].tolist())
    assert len(group[held].unique()) == 5
    assert not torch.equal(held, split_groups(group, seed + 1)[1])
    assert torch.equal(held, split_groups(group, seed)[1])


def test_one_group_cannot_be_split():
    with pytest.raises(InputError, match=r"at least 2 episodes or runs.*got 1"):
        split_groups(torch.zeros(5, dtype=torch.int64), 0)


def test_loading_joins_shards_and_names_what_is_wrong(tmp_path):
    tensors = write_arrivals(tmp_path)
    save_file(tensors, tmp_path / "arrivals-1-000.safetensors")
    loaded = load_arrivals(tmp_path)
    assert torch.equal(loaded.goal, torch.cat([tensors["goal"]] * 2))
    save_file(tensors | {"goal": tensors["goal"] * float("nan")}, tmp_path / "arrivals-1-000.safetensors")
    with pytest.raises(InputError, match=r"goal of the arrivals in .* must be finite"):
        load_arrivals(tmp_path)
    save_file({k: v for k, v in tensors.items() if k != "run"}, tmp_path / "arrivals-1-000.safetensors")
    with pytest.raises(InputError, match=r"arrivals-1-000\.safetensors' lacks run"):
        load_arrivals(tmp_path)
