import os
import pickle
import subprocess
import sys

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.fused import Fused


def turned(place, angle):
    """A vector of two columns turned by an angle, and a constant beside its first entry."""
    (x, y), (q,) = place, angle
    cos, sin = torch.cos(q), torch.sin(q)
    return [x * cos - y * sin, x * sin + y * cos], [x, 2.0]


FUSED = Fused(turned)


@pytest.mark.parametrize("rows", [0, 1, 5, 64, 300])
def test_it_is_the_function_of_columns_for_any_number_of_rows(rows):
    place, angle = torch.randn(rows, 2), torch.randn(rows, 1)
    moved, beside = FUSED(place, angle)
    expected = torch.stack(turned(place.unbind(-1), angle.unbind(-1))[0], dim=-1)
    torch.testing.assert_close(moved, expected, atol=1e-6, rtol=0)
    assert torch.equal(beside[:, 0], place[:, 0])
    assert (beside[:, 1] == 2.0).all()


def test_rows_do_not_depend_on_their_batch():
    place, angle = torch.randn(100, 2), torch.randn(100, 1)
    whole = FUSED(place, angle)[0]
    for part in (slice(0, 1), slice(3, 20), slice(97, 100)):
        assert torch.equal(FUSED(place[part], angle[part])[0], whole[part])


def test_another_precision_is_compiled_for_itself():
    place, angle = torch.randn(3, 2, dtype=torch.float64), torch.randn(3, 1, dtype=torch.float64)
    expected = torch.stack(turned(place.unbind(-1), angle.unbind(-1))[0], dim=-1)
    torch.testing.assert_close(FUSED(place, angle)[0], expected, atol=1e-14, rtol=0)


def test_gradients_are_refused():
    with pytest.raises(InputError, match="a compiled solve has no derivatives"):
        FUSED(torch.randn(3, 2, requires_grad=True), torch.randn(3, 1))


def test_a_copy_leaves_behind_what_was_compiled():
    assert pickle.loads(pickle.dumps(FUSED))._compiled == {}


@pytest.mark.slow  # torch's compiler starts from nothing
def test_without_a_compiler_the_error_says_so(tmp_path):
    code = (
        "import torch\nfrom torchdyn_plan.kinematics.fused import Fused\n"
        "from torchdyn_plan.errors import CompileError\n"
        "try: Fused(lambda x: ([x[0] + 1.0],))(torch.zeros(1, 1))\n"
        "except CompileError as error: print(error)"
    )
    environment = {**os.environ, "CXX": "no-such-compiler", "TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}
    environment |= {"TORCHINDUCTOR_COMPILE_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert "cannot be compiled; it needs a working C++ compiler" in done.stdout, done.stderr
