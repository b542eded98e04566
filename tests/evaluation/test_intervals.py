import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.intervals import Z_95, paired_loss, rate, wilson_interval


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_published_intervals(successes, trials, low, high):
    found = rate(successes, trials)
    assert found.value == successes / trials
    assert (found.low, found.high) == pytest.approx((low, high), abs=5e-5)


@given(trials=st.integers(1, 10_000), share=st.floats(0, 1))
def test_ends_are_where_the_score_test_just_rejects(trials, share):
    successes = round(share * trials)
    found = rate(successes, trials)
    assert 0 <= found.low <= found.value <= found.high <= 1
    for end in {found.low, found.high} - {0.0, 1.0}:
        z = (found.value - end) / math.sqrt(end * (1 - end) / trials)
        assert abs(z) == pytest.approx(Z_95, rel=1e-6)


@given(trials=st.integers(1, 1000), successes=st.integers(0, 1000))
def test_failures_mirror_successes(trials, successes):
    successes = min(successes, trials)
    one, other = rate(successes, trials), rate(trials - successes, trials)
    assert (one.low, one.high) == pytest.approx((1 - other.high, 1 - other.low), abs=1e-12)


def test_a_batch_is_its_rows():
    successes, trials = torch.tensor([[0, 3], [5, 9]]), torch.tensor([[4, 7], [5, 0]]).maximum(torch.tensor(9))
    low, high = wilson_interval(successes, trials)
    rows = [rate(int(k), int(n)) for k, n in zip(successes.flatten(), trials.flatten(), strict=True)]
    assert low.shape == high.shape == (2, 2)
    assert low.flatten().tolist() == [row.low for row in rows]
    assert high.flatten().tolist() == [row.high for row in rows]


def test_no_trials_know_nothing():
    found = rate(0, 0)
    assert math.isnan(found.value)
    assert (found.low, found.high) == (0.0, 1.0)


@pytest.mark.parametrize(("successes", "trials"), [(-1, 5), (6, 5), (1, 0)])
def test_impossible_counts_are_refused(successes, trials):
    with pytest.raises(InputError, match="successes must lie between 0 and trials"):
        rate(successes, trials)


def test_a_paired_loss_counts_what_one_has_and_the_other_has_not():
    before = torch.tensor([True] * 90 + [False] * 10)
    after = torch.tensor([True] * 80 + [False] * 15 + [True] * 5)
    loss = paired_loss(before, after)
    assert loss.value == pytest.approx(0.05)
    half = Z_95 * math.sqrt((15 / 100 - 0.05**2) / 100)
    assert (loss.low, loss.high) == pytest.approx((0.05 - half, 0.05 + half))
    assert paired_loss(before, before) == (0.0, 0.0, 0.0)
    assert math.isnan(paired_loss(before[:0], before[:0]).value)
    with pytest.raises(InputError, match=r"\(100,\) and \(3,\)"):
        paired_loss(before, before[:3])
