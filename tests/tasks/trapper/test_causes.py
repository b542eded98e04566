import pytest
import torch

from torchdyn_plan.evaluation.results import NO_CAUSE
from torchdyn_plan.tasks.trapper.causes import ETA_TOLERANCE, FORECAST_TOLERANCE, failure_cause
from torchdyn_plan.tasks.trapper.evidence import NEVER, Evidence
from torchdyn_plan.tasks.trapper.task import TASK

CAUSES = TASK.causes
FAIR = {
    "trapped": False,
    "solvable": True,
    "touched": False,
    "pocketed": False,
    "planned": True,
    "promised": True,
    "forecast_error": 0.0,
    "eta_error": 0,
    "contact_step": -1,
    "receding": False,
}


def causes(*rows):
    """Name of the cause of each hand-made episode; None for a success."""
    columns = {name: torch.tensor([(FAIR | row)[name] for row in rows]) for name in FAIR}
    clues = Evidence(*(columns.pop(name) for name in Evidence._fields))
    codes = failure_cause(*columns.values(), clues)
    assert codes.dtype == torch.int64
    return [None if code == NO_CAUSE else CAUSES[code] for code in codes.tolist()]


LAWS = [
    ("unreachable", {"solvable": False}),
    ("planner_too_slow", {"promised": False}),
    ("forecast", {"forecast_error": FORECAST_TOLERANCE + 1e-4}),
    ("eta", {"eta_error": ETA_TOLERANCE + 1}),
    ("eta", {"eta_error": NEVER}),
    ("early_contact", {"touched": True, "contact_step": 90}),
    ("early_contact", {"touched": True, "planned": False, "promised": False}),
    ("pocketed", {"pocketed": True, "planned": False, "promised": False}),
    ("late", {}),
    ("late", {"touched": True, "receding": True}),
    ("late", {"planned": False, "promised": False}),
    ("late", {"pocketed": True}),
    ("late", {"forecast_error": FORECAST_TOLERANCE - 1e-4, "eta_error": ETA_TOLERANCE}),
    ("late", {"eta_error": -90}),
]


@pytest.mark.parametrize(("name", "row"), LAWS)
def test_each_law(name, row):
    assert causes(row) == [name]


def test_every_cause_has_a_law():
    assert {name for name, _ in LAWS} == set(CAUSES)


def test_the_first_cause_that_holds_counts():
    everything = {
        "solvable": False,
        "promised": True,
        "forecast_error": 1.0,
        "eta_error": NEVER,
        "touched": True,
        "pocketed": True,
    }
    rows = [everything]
    for change in (
        {"solvable": True, "promised": False},
        {"promised": True},
        {"forecast_error": 0.0},
        {"eta_error": 0},
        {"touched": False, "planned": False, "promised": False},
        {"pocketed": False},
    ):
        rows.append(rows[-1] | change)
    assert causes(*rows) == list(CAUSES)


def test_a_trapped_ball_has_no_cause_whatever_else_happened():
    assert causes({"trapped": True}, {"trapped": True, "solvable": False, "touched": True}) == [None, None]


def test_errors_without_a_promise_do_not_count():
    assert causes({"planned": False, "promised": False, "forecast_error": 9.0, "eta_error": NEVER}) == ["late"]


def test_any_batch_shape():
    random = torch.Generator().manual_seed(0)
    flags = torch.rand(4, 3, 5, generator=random) > 0.5
    clues = torch.rand(3, 3, 5, generator=random) > 0.5
    errors = 0.08 * torch.rand(3, 5, generator=random), torch.randint(-9, 20, (3, 5), generator=random)
    evidence = Evidence(clues[0], clues[1], *errors, errors[1], clues[2])
    together = failure_cause(*flags, evidence)
    assert together.shape == (3, 5)
    flat = failure_cause(*flags.flatten(1), Evidence(*(clue.flatten() for clue in evidence)))
    assert together.flatten().tolist() == flat.tolist()
    assert failure_cause(*flags[:, 0, 0], Evidence(*(clue[0, 0] for clue in evidence))).shape == ()
