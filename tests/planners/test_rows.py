import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchdyn_plan.planners.rows import apply_to_rows


@given(
    mask=st.lists(st.booleans(), min_size=1, max_size=12),
    chunk=st.one_of(st.none(), st.integers(1, 5)),
)
def test_chosen_rows_are_replaced_and_the_others_kept(mask, chunk):
    mask = torch.tensor(mask)
    x, old = torch.arange(len(mask)).double(), -torch.ones(len(mask), 2)
    (new,) = apply_to_rows(lambda v: (v[:, None].expand(-1, 2) * 2,), mask, (x,), (old,), chunk=chunk)
    expected = torch.where(mask[:, None], x[:, None] * 2, -1.0).expand(-1, 2)
    assert torch.equal(new, expected.float())
    assert new.dtype == old.dtype
    assert torch.equal(old, -torch.ones(len(mask), 2))


@pytest.mark.parametrize("batch", [(), (3,), (2, 5), (2, 1, 3)])
def test_any_leading_batch_dimensions(batch):
    mask = torch.rand(batch, generator=torch.Generator().manual_seed(0)) < 0.6
    x = torch.rand(*batch, 4, 3)
    old = torch.zeros(*batch, 3), torch.zeros(batch, dtype=torch.bool)
    new = apply_to_rows(lambda v: (v.sum(-2), v[:, 0, 0] >= 0), mask, (x,), old, chunk=2)
    torch.testing.assert_close(new[0], x.sum(-2) * mask[..., None])
    assert torch.equal(new[1], mask)


def test_the_function_sees_blocks_of_exactly_chunk_rows():
    seen = []

    def function(v):
        seen.append(v.tolist())
        return (v,)

    mask = torch.tensor([True, False, True, True, True, True])
    apply_to_rows(function, mask, (torch.arange(6),), (torch.zeros(6),), chunk=3)
    assert seen == [[0, 2, 3], [4, 5, 5]]


def test_no_row_means_no_call():
    old = (torch.ones(3),)

    def never(*_):
        raise AssertionError("called without a row")

    assert apply_to_rows(never, torch.zeros(3, dtype=torch.bool), (torch.ones(3),), old)[0] is old[0]


def test_with_a_chunk_a_rows_result_does_not_depend_on_its_company():
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(15, 64), torch.nn.ReLU(), torch.nn.Linear(64, 7))
    x, old = torch.randn(200, 15), (torch.zeros(200, 7),)
    with torch.no_grad():
        together = apply_to_rows(lambda v: (net(v),), torch.ones(200, dtype=torch.bool), (x,), old, chunk=16)[0]
        for keep in (0.01, 0.1, 0.5):
            mask = torch.rand(200) < keep
            some = apply_to_rows(lambda v: (net(v),), mask, (x,), old, chunk=16)[0]
            assert torch.equal(some[mask], together[mask])


def test_gradients_reach_the_chosen_rows_only():
    x, mask = torch.rand(4, 2, dtype=torch.float64, requires_grad=True), torch.tensor([True, False, True, False])
    old = torch.zeros(4, 2, dtype=torch.float64)
    (new,) = apply_to_rows(lambda v: (v**2,), mask, (x,), (old,), chunk=3)
    new.sum().backward()
    torch.testing.assert_close(x.grad, 2 * x.detach() * mask[:, None])
