import pytest
import torch

from tests.tasks.trapper.test_evidence import record
from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.evaluation.results import NO_CAUSE, EpisodeOutcomes
from torchdyn_plan.kinematics import UR5_SPEED_LIMIT
from torchdyn_plan.tasks.trapper.causes import (
    ETA_TOLERANCE,
    FORECAST_TOLERANCE,
    JOINT_SPEED,
    failure_cause,
    fastest,
    measure,
)
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


def outcomes(success, speed):
    count = len(success)
    none = torch.full((count,), -1)
    return EpisodeOutcomes(
        success=torch.tensor(success),
        steps=none,
        replans=none,
        solvable=torch.ones(count, dtype=torch.bool),
        evidence={} if speed is None else {JOINT_SPEED: torch.tensor(speed)},
        cause=none,
        seconds=1.0,
    )


def test_a_peak_of_joint_speed_lies_within_the_episode():
    trace = record(length=60)
    trace.joint_speed[0, 60] = 2.0 * UR5_SPEED_LIMIT
    trace.joint_speed[0, 61] = 9.0
    assert fastest(trace).tolist() == pytest.approx([2.0 * UR5_SPEED_LIMIT])


def test_joint_speeds_are_counted_in_successes_and_their_peak_in_all():
    found = measure(outcomes([True, True, False, True], [1.01, 1.5, 4.0, 0.9]))
    assert found == {"joint_speed_peak": 4.0, "joint_speed_above": pytest.approx(1 / 3)}
    assert measure(outcomes([False], [1.5])) == {"joint_speed_peak": 1.5, "joint_speed_above": None}
    assert measure(outcomes([True], None)) == {"joint_speed_peak": None, "joint_speed_above": None}


def test_an_evaluation_tells_how_fast_joints_were():
    found = evaluate("trapper", ["pursuit"], episodes=2, num_envs=2, num_threads=1, split="dev", progress=False)
    speed = found.outcomes["pursuit"].evidence[JOINT_SPEED]
    # A pursuing arm is driven at its limits.
    assert ((speed > 0.5) & (speed < 9.0)).all()
    assert found.rows[0].measures["joint_speed_peak"] == speed.max().item()
    assert "joint speed peak" in found.table()
