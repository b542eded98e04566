import pytest
import torch

from torchdyn_plan.nets.cushions import fold


@pytest.mark.parametrize(
    ("value", "folded"), [(0.3, 0.3), (1.2, 0.8), (-1.2, -0.8), (2.5, -0.5), (3.5, -0.5), (4.25, 0.25)]
)
def test_fold_by_hand(value, folded):
    assert fold(torch.tensor(value), 1.0).item() == pytest.approx(folded)


def test_fold_is_odd_periodic_and_inside():
    line = torch.linspace(-9, 9, 1001, dtype=torch.float64)
    folded = fold(line, 0.7)
    assert folded.abs().max() <= 0.7 + 1e-12
    torch.testing.assert_close(fold(-line, 0.7), -folded)
    torch.testing.assert_close(fold(line + 2.8, 0.7), folded)


def test_fold_has_unit_slope():
    line = torch.tensor([0.3, 1.3, -2.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: fold(x, 1.0), line)
    (slope,) = torch.autograd.grad(fold(line, 1.0).sum(), line)
    assert slope.abs().tolist() == [1.0, 1.0, 1.0]
