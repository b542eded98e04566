import math

import pytest
import torch

from torchdyn_plan import checks
from torchdyn_plan.errors import InputError, OutputError, TorchdynPlanError
from torchdyn_plan.files import check_writable_folder


def test_trailing_shape_lets_any_batch_through():
    for batch in ((), (5,), (2, 3), (0,)):
        checks.check_trailing_shape("history", torch.zeros(*batch, 24, 3), 24, 3)
    checks.check_trailing_shape("steps", torch.zeros(4))


@pytest.mark.parametrize("shape", [(3,), (23, 3), (24, 2), (24, 3, 1), ()])
def test_trailing_shape_names_both_shapes(shape):
    with pytest.raises(InputError) as caught:
        checks.check_trailing_shape("history", torch.zeros(shape), 24, 3)
    assert str(caught.value) == f"history must have shape (*B, 24, 3), got {tuple(shape)}"


def test_trailing_shape_wants_a_tensor():
    with pytest.raises(InputError, match=r"history must be a torch\.Tensor, got list"):
        checks.check_trailing_shape("history", [0.0], 1)  # pyright: ignore[reportArgumentType]


def test_finite_counts_the_bad_values():
    checks.check_finite("history", torch.ones(3))
    with pytest.raises(InputError, match="history must be finite, got 2 NaN or infinite values of 4"):
        checks.check_finite("history", torch.tensor([0.0, math.nan, math.inf, 1.0]))


def test_devices_must_agree():
    checks.check_same_device("goal", torch.zeros(1), torch.device("cpu"), "the planner")
    with pytest.raises(InputError, match="goal is on meta, but the planner is on cpu"):
        checks.check_same_device("goal", torch.zeros(1, device="meta"), torch.device("cpu"), "the planner")


def test_an_unknown_choice_is_named_with_its_nearest():
    checks.check_choice("planner", "corner", ["pursuit", "corner"])
    with pytest.raises(InputError) as caught:
        checks.check_choice("planner", "cornr", ["pursuit", "corner"])
    assert str(caught.value) == "unknown planner 'cornr' (did you mean 'corner'?); choose from corner, pursuit"
    with pytest.raises(InputError, match="unknown planner 'xyz'; choose from corner"):
        checks.check_choice("planner", "xyz", ["corner"])


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "3", None])
def test_a_number_is_finite(value):
    with pytest.raises(InputError, match="velocity must be a finite number"):
        checks.check_number("velocity", value)


@pytest.mark.parametrize("value", [0.0, 2, 5.0])
def test_numbers_within_their_bounds_pass(value):
    checks.check_number("velocity", value, minimum=0.0, maximum=5.0)


def test_bounds_are_told():
    with pytest.raises(InputError, match=r"velocity must be in \[0, 5\], got 5.1"):
        checks.check_number("velocity", 5.1, minimum=0.0, maximum=5.0)
    with pytest.raises(InputError, match=r"velocity must be >= 0, got -1"):
        checks.check_number("velocity", -1, minimum=0.0)
    with pytest.raises(InputError, match=r"episodes must be an integer, got 2.0"):
        checks.check_number("episodes", 2.0, integer=True)


def test_a_writable_folder_is_made_and_left_empty(tmp_path):
    folder = check_writable_folder(tmp_path / "a" / "b")
    assert folder.is_dir()
    assert list(folder.iterdir()) == []


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "file").write_text("here first")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="is not writable") as caught:
            check_writable_folder(folder)
        assert str(folder) in str(caught.value)


def test_errors_are_one_family_and_of_the_builtin_kind():
    assert issubclass(InputError, TorchdynPlanError)
    assert issubclass(InputError, ValueError)
    assert issubclass(OutputError, TorchdynPlanError)
    assert issubclass(OutputError, OSError)
