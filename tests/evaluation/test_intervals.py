import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.intervals import (
    Z_95,
    interquartile_mean,
    interquartile_mean_interval,
    mcnemar,
    paired_loss,
    rate,
    sign_test,
    wilson_interval,
)


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


@pytest.mark.parametrize(
    ("lost", "won", "p"),
    # scipy.stats.binomtest(lost, lost + won).pvalue, scipy 1.17.1.
    [(5, 15, 0.041389465332031215), (38, 56, 0.07897554800108206), (0, 0, 1.0), (7, 7, 1.0), (0, 10, 0.001953125)],
)
def test_the_exact_test_of_pairs_is_scipy_s(lost, won, p):
    before = torch.tensor([True] * lost + [False] * won + [True] * 9 + [False] * 4)
    after = torch.tensor([False] * lost + [True] * won + [True] * 9 + [False] * 4)
    assert mcnemar(before, after) == pytest.approx(p, rel=1e-12)
    assert mcnemar(after, before) == mcnemar(before, after)


def test_the_exact_test_takes_many_episodes_and_no_nonsense():
    assert 0.0 < sign_test(4000, 4600) < 1e-9
    with pytest.raises(InputError, match=r"\(3,\) and \(2,\)"):
        mcnemar(torch.ones(3, dtype=torch.bool), torch.ones(2, dtype=torch.bool))
    with pytest.raises(InputError, match="fewer than none, got -1 and 3"):
        sign_test(-1, 3)


FIVE = torch.tensor(
    [
        [0.965, 0.931, 0.801],
        [0.951, 0.902, 0.822],
        [0.972, 0.944, 0.768],
        [0.940, 0.915, 0.790],
        [0.958, 0.921, 0.835],
    ],
    dtype=torch.float64,
)
"""Success of five trainings in three settings, made up."""


def test_interquartile_mean_and_interval_are_rliable_s():
    # rliable 1.2.0: metrics.aggregate_iqm, and library.get_interval_estimates with 50,000 repetitions.
    found = interquartile_mean_interval(FIVE)
    assert found.value == pytest.approx(0.9067777777777778, abs=1e-12)
    assert (found.low, found.high) == pytest.approx((0.89677778, 0.91466667), abs=4e-4)
    spread = torch.tensor([[0.0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 20]])
    assert interquartile_mean_interval(spread) == pytest.approx((5.5, 3.0, 8.0), abs=0.2)


def test_interquartile_mean_leaves_out_the_ends_and_takes_a_batch():
    assert interquartile_mean(torch.tensor([[1.0, 2.0], [3.0, 100.0], [5.0, 6.0]])).item() == 4.0
    batch = torch.stack([FIVE, FIVE.flip(0) / 2])
    assert interquartile_mean(batch).tolist() == pytest.approx([0.9067777777777778, 0.4533888888888889])


def test_one_training_leaves_nothing_to_resample():
    found = interquartile_mean_interval(FIVE[:1])
    assert found.low == found.value == found.high


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        (torch.ones(3), r"shape \(R, K\), got \(3,\)"),
        (torch.ones(0, 3), r"got \(0, 3\)"),
        (torch.full((2, 2), math.nan), "scores must be finite"),
    ],
)
def test_scores_that_are_none_are_refused(scores, message):
    with pytest.raises(InputError, match=message):
        interquartile_mean_interval(scores)
