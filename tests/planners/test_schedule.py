import math

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import EventSchedule, Observation, Plan, ReplanSchedule
from torchdyn_plan.planners.schedule import Clock

PAPER_STEPS = [13, 80, 140, 194, 242, 285, 323, 357, 387, 414, 439, 464, 489]
PAPER_WINDOWS = [67, 60, 54, 48, 43, 38, 34, 30, 27, 25, 25, 25, 25]


def seen(step_count):
    """Observation of targets at the origin at steps ``step_count`` (*B,)."""
    place = torch.zeros(*step_count.shape, 3)
    return Observation(place, place, place, step_count, ())


def in_time(rows):
    """Robots that are never late."""
    return torch.zeros(rows.shape)


def tick(schedule, clock, step_count, *, plan=None, busy=None, late=in_time):
    """Clock and due rows at steps ``step_count`` (*B,), from the ``clock`` of the step before; fresh at step 0."""
    observation = seen(step_count)
    start = schedule.start(observation)
    if clock is not None:
        pairs = zip(start, clock.older(), strict=True)
        start = Clock(*(torch.where(step_count == 0, new, old) for new, old in pairs))
    plan = Plan.hold(observation, 1) if plan is None else plan
    return schedule.tick(start, observation, plan, busy=busy, late=late)


def run(schedule, steps):
    """Steps at which a plan was due, and the windows that began there, of one episode."""
    clock, due_at, windows = None, [], []
    for t in range(steps):
        clock, due = tick(schedule, clock, torch.tensor([t]))
        if due:
            due_at.append(t)
            windows.append(int(clock.window))
            assert int(clock.replans) == len(due_at)
    return due_at, windows


def test_the_papers_episode():
    assert run(ReplanSchedule(), 500) == (PAPER_STEPS, PAPER_WINDOWS)


def test_countdown_tells_the_steps_to_the_next_plan():
    clock = None
    for t in range(500):
        clock, due = tick(ReplanSchedule(), clock, torch.tensor([t]))
        coming = [s for s in PAPER_STEPS if s > t]
        if coming:
            assert int(clock.countdown) == coming[0] - t
        assert bool(due) == (t in PAPER_STEPS)


def test_windows_agree_with_the_papers_integer_arithmetic_everywhere():
    window = torch.arange(1, 100_000)
    expected = torch.tensor([max(int(0.9 * w), 25) for w in range(1, 100_000)])
    assert torch.equal(ReplanSchedule().next_window(window), expected)


@pytest.mark.parametrize("hundredths", range(0, 101, 3))
def test_any_factor_is_taken_as_the_decimal_it_is_written(hundredths):
    window = torch.arange(1, 20_000)
    schedule = ReplanSchedule(shrink=hundredths / 100, minimum=1)
    assert torch.equal(schedule.next_window(window), (window * hundredths // 100).clamp_min(1))


def test_rows_that_reset_start_afresh_and_leave_the_others_alone():
    """Row r starts over every 50 + 30 r steps; each row behaves as if it were alone."""
    period = torch.tensor([50, 80, 110, 500])
    schedule, clock, got = ReplanSchedule(), None, [[] for _ in period]
    for t in range(500):
        clock, due = tick(schedule, clock, t % period)
        for row in due.nonzero().flatten().tolist():
            got[row].append(t)
    for row, p in enumerate(period.tolist()):
        assert got[row] == [t for t in range(500) if t % p in PAPER_STEPS]


def test_a_clock_that_is_first_read_in_mid_episode_plans_at_once():
    clock, due = tick(ReplanSchedule(), None, torch.tensor([[5, 13], [14, 300]]))
    assert due.tolist() == [[False, True], [True, True]]
    assert clock.countdown.tolist() == [[8, 67], [67, 67]]


def test_other_tasks_change_numbers_only():
    due_at, windows = run(ReplanSchedule(first_step=0, window=8, shrink=0.5, minimum=1), 12)
    assert due_at == [0, 4, 6, 7, 8, 9, 10, 11]
    assert windows == [4, 2, 1, 1, 1, 1, 1, 1]


@pytest.mark.parametrize(
    "bad", [{"first_step": -1}, {"window": 0}, {"window": 7.5}, {"shrink": 1.5}, {"shrink": math.nan}, {"minimum": 0}]
)
def test_bad_numbers_are_named(bad):
    with pytest.raises(InputError, match=f"{next(iter(bad))}.*{next(iter(bad.values()))}"):
        ReplanSchedule(**bad)


def plan_of(miss, over):
    """A plan by which the target at the origin should be ``miss`` (N,) away, and is met now where ``over`` (N,)."""
    count = len(miss)
    plan = Plan.hold(seen(torch.ones(count, dtype=torch.int64)), 1)
    path = torch.nn.functional.pad(miss.reshape(count, 1, 1), (0, 2))
    return plan._replace(path=path, arrival_steps=torch.where(over, 0, 30))


class Looks:
    """How the plan fits at each step, and the steps at which somebody looked."""

    def __init__(self, miss=(), late=(), over=()):
        self.miss, self.late, self.over, self.seen, self.now = miss, late, over, [], 0

    @property
    def plan(self):
        return plan_of(torch.tensor([1.0 if self.now in self.miss else 0.0]), torch.tensor([self.now in self.over]))

    def __call__(self, rows):
        self.seen.append(self.now)
        return torch.full(rows.shape, 9.0 if self.now in self.late else 0.0)


def watch(schedule, steps, looks, busy=()):
    clock, due_at = None, []
    for t in range(steps):
        looks.now = t
        step, now_busy = torch.tensor([t]), torch.tensor([t in busy])
        clock, due = tick(schedule, clock, step, plan=looks.plan, busy=now_busy, late=looks)
        if due:
            due_at.append(t)
    return due_at


EVENTS = EventSchedule(first_step=13, every=5, minimum=10, maximum=30, miss=0.5, late=5.0)


def test_without_events_only_the_longest_time_counts():
    looks = Looks()
    assert watch(EVENTS, 80, looks) == [13, 43, 73]
    assert looks.seen == [23, 28, 33, 38, 53, 58, 63, 68]


@pytest.mark.parametrize("what", ["miss", "late", "over"])
def test_an_event_is_answered_at_the_next_look_but_not_before_the_shortest_time(what):
    assert watch(EVENTS, 60, Looks(**{what: range(14, 34)})) == [13, 23, 33]
    assert watch(EVENTS, 60, Looks(**{what: [24]})) == [13, 43]
    assert watch(EVENTS, 60, Looks(**{what: [28]})) == [13, 28, 58]


def test_a_busy_row_plans_at_the_next_look():
    assert watch(EVENTS, 60, Looks(miss=range(60)), busy=range(14, 25)) == [13, 28, 38, 48, 58]
    assert watch(EVENTS, 60, Looks(), busy=range(40, 50)) == [13, 53]
    every = ReplanSchedule.every(5, first_step=3)
    assert watch(every, 30, Looks(), busy=[*range(4, 12), 13]) == [3, 18, 23, 28]


def test_rows_with_events_leave_the_others_alone():
    clock, got = None, [[], [], []]
    for t in range(80):
        plan = plan_of(torch.tensor([1.0, 0.0, 0.0]) * (t == 28), torch.zeros(3, dtype=torch.bool))
        clock, due = tick(EVENTS, clock, torch.tensor([t, t, t % 40]), plan=plan)
        for row in due.nonzero().flatten().tolist():
            got[row].append(t)
    assert got == [[13, 28, 58], [13, 43, 73], [13, 53]]


def test_every_few_steps():
    assert run(ReplanSchedule.every(7, first_step=2), 24)[0] == [2, 9, 16, 23]
    assert ReplanSchedule.every(7).longest == 7
    assert ReplanSchedule().longest == 67


@pytest.mark.parametrize(
    "bad",
    [
        {"first_step": -1},
        {"every": 0},
        {"minimum": 7},
        {"maximum": 52},
        {"maximum": 4},
        {"miss": -0.1},
        {"late": math.nan},
    ],
)
def test_a_bad_event_schedule_is_refused(bad):
    with pytest.raises(InputError, match=f"{next(iter(bad))}.*{next(iter(bad.values()))}"):
        EventSchedule(**bad)
