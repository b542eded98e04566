import pytest
import torch

from torchdyn_plan.nets.reflection import reflect


@pytest.mark.parametrize(
    ("value", "reflected"), [(0.3, 0.3), (1.2, 0.8), (-1.2, -0.8), (2.5, -0.5), (3.5, -0.5), (4.25, 0.25)]
)
def test_reflection_by_hand(value, reflected):
    assert reflect(torch.tensor(value), 1.0).item() == pytest.approx(reflected)


def test_a_reflected_line_is_odd_periodic_and_inside():
    line = torch.linspace(-9, 9, 1001, dtype=torch.float64)
    reflected = reflect(line, 0.7)
    assert reflected.abs().max() <= 0.7 + 1e-12
    torch.testing.assert_close(reflect(-line, 0.7), -reflected)
    torch.testing.assert_close(reflect(line + 2.8, 0.7), reflected)


def test_a_reflected_line_has_unit_slope():
    line = torch.tensor([0.3, 1.3, -2.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: reflect(x, 1.0), line)
    (slope,) = torch.autograd.grad(reflect(line, 1.0).sum(), line)
    assert slope.abs().tolist() == [1.0, 1.0, 1.0]
