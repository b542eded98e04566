"""People's mistakes at random: whatever is in a tensordict, a planner works or says in one sentence why not."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.torture import mistakes
from benchmarks.torture.mistakes import ENTRIES, GONE, PLANNERS, WHOLE, keys_of, make_mistakes, still_works, verdict

CASES = 600
"""Of each planner: more than ten thousand together."""


def check(name, changes, whole):
    try:
        seen = make_mistakes(name, changes, whole)
    except Exception:
        return  # The tensordict refuses it: no planner sees it.
    assert verdict(name, seen) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANNERS)
def test_no_mistake_ends_in_an_error_of_another_library(name):
    mistake = st.tuples(st.sampled_from(keys_of(name)), st.sampled_from([GONE, *ENTRIES]))

    @settings(max_examples=CASES, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(changes=st.lists(mistake, max_size=3), whole=st.sampled_from(["as it is", *WHOLE]))
    def fuzz(changes, whole):
        check(name, changes, whole)

    fuzz()
    assert still_works(name) is None


def test_there_are_ten_thousand_cases():
    assert CASES * len(PLANNERS) >= 10_000


@pytest.mark.parametrize("name", ["wait and drop", "policy that holds", "reach corner"])
@pytest.mark.parametrize("change", ["transposed", "complex", "text", "sparse", "tensordict", "one less"])
def test_each_entry_of_a_memory_that_is_spoiled_is_told(name, change):
    for key in keys_of(name):
        if isinstance(key, tuple):
            check(name, [(key, change)], "as it is")


@pytest.mark.parametrize("whole", WHOLE)
def test_tensordicts_of_every_kind_are_taken_or_refused(whole):
    check("corner", [], whole)


def test_an_error_of_another_library_would_be_seen(monkeypatch):
    def broken(seen):
        raise RuntimeError("The size of tensor a must match the size of tensor b")

    monkeypatch.setattr(mistakes, "planner", lambda name: broken)
    with pytest.raises(AssertionError, match="RuntimeError"):
        check("corner", [], "as it is")
