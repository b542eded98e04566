import numpy as np
import pytest
import torch

from torchdyn_plan import envs
from torchdyn_plan.envs.episodes import SPLITS, draw_uniform, episode_random
from torchdyn_plan.errors import InputError


def test_an_episode_is_drawn_alike_whatever_stands_beside_it():
    whole = draw_uniform(torch.arange(6), 4, split="dev", seed=3)
    assert whole.shape == (6, 4)
    assert whole.dtype == torch.float64
    assert whole.abs().max() <= 1.0
    assert torch.equal(draw_uniform(torch.tensor([4, 1]), 4, split="dev", seed=3), whole[[4, 1]])


def test_no_two_splits_seeds_or_episodes_share_their_draws():
    draws = [
        tuple(draw_uniform(torch.arange(3), 2, split=split, seed=seed)[:, 0].tolist())
        for split in SPLITS
        for seed in range(3)
    ]
    values = [value for draw in draws for value in draw]
    assert len(set(values)) == len(values)


def test_draws_are_numpys_of_split_seed_and_index():
    expected = np.random.default_rng((SPLITS["train"], 7, 2)).uniform(-1.0, 1.0, 4)
    assert draw_uniform(torch.tensor([2]), 4, split="train", seed=7)[0].tolist() == expected.tolist()
    assert episode_random("train", 7, 2, 1).uniform() != episode_random("train", 7, 2).uniform()


def test_an_unknown_split_is_named():
    with pytest.raises(InputError, match="unknown split 'tset'"):
        draw_uniform(torch.arange(2), 2, split="tset", seed=0)


def test_the_package_shows_what_it_says():
    for name in envs.__all__:
        assert getattr(envs, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'Nothing'"):
        _ = envs.Nothing
