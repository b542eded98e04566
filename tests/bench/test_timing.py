import pytest

from torchdyn_plan.bench.timing import figures, sample


def test_figures_are_in_microseconds_and_for_one_item():
    row = figures([1e-6, 2e-6, 3e-6, 10e-6], batch=2)
    assert row["median_us"] == pytest.approx(2.5)
    assert row["p95_us"] == pytest.approx(8.95)
    assert row["per_item_us"] == pytest.approx(2.0)


def test_a_sample_has_its_least_number_of_calls_and_one_more_is_not_counted():
    calls = []
    assert len(sample(lambda: calls.append(0), seconds=0.0, least=5)) == 5
    assert len(calls) == 6
