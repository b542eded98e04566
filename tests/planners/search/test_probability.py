import dataclasses

import pytest
import torch

from tests.planners.search.test_exact import FULL, POCKETED, paths, robot
from torchdyn_plan.nets import Arrival, Forecast, FunctionCapture, Spread
from torchdyn_plan.nets.distributions import decode_distribution, decode_expectation
from torchdyn_plan.planners import SearchContext, SoftExactSearch
from torchdyn_plan.planners.search.exact import meeting_probability

CAUTIOUS = dataclasses.replace(FULL, probability_weight=15.0)
HALF = 0.05


def spread_of(*batch, scale=0.02, shape=2.0, gone=0.0, steps=90):
    full = torch.ones(*batch, steps, 2, dtype=torch.float64)
    return Spread(scale * full, shape * full, gone * full[..., 0])


def sharp(steps, bins=100):
    """Arrival that is certain to fall into the bin of ``steps``."""
    logits = torch.full((*steps.shape, bins + 1), -1e4, dtype=torch.float64)
    return decode_distribution(logits.scatter(-1, (steps / 5).long().unsqueeze(-1), 1e4))


def blurred_logits(*batch, seed=0):
    draw = torch.Generator().manual_seed(seed)
    return torch.randn(*batch, 101, generator=draw, dtype=torch.float64)


def blurred(*batch, seed=0):
    return decode_distribution(blurred_logits(*batch, seed=seed))


def offsets(*batch, seed=0):
    return 0.1 * torch.rand(*batch, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.05


def test_they_are_probabilities():
    arrival, time = blurred(7, 90), torch.arange(90.0) * 6 - 20
    for spread in (None, spread_of(7), spread_of(7, gone=0.7), spread_of(7, scale=1e-12), spread_of(7, scale=1e6)):
        probability = meeting_probability(arrival, arrival.steps, time, spread, offsets(7, 90), half_width=HALF)
        assert probability.shape == (7, 90)
        assert bool(((probability >= 0) & (probability <= 1)).all())


def test_more_time_is_never_worse_and_more_spread_never_better():
    arrival, offset = blurred(5, 90), offsets(5, 90)

    def by(time, scale=0.02, share=1.0):
        spread = spread_of(5, scale=scale)
        return meeting_probability(arrival, arrival.steps, torch.tensor(time), spread, share * offset, half_width=HALF)

    probability = torch.stack([by(time) for time in range(-10, 520, 7)])
    assert bool((probability.diff(dim=0) >= 0).all())
    assert bool((probability[-1] > probability[0]).all())
    # The place must be well inside: a target that is forecast outside comes in by its spread alone.
    probability = torch.stack([by(300, scale, 0.2) for scale in (1e-4, 1e-3, 1e-2, 1e-1)])
    assert bool((probability.diff(dim=0) < 0).all())


def test_a_gone_target_is_not_met():
    arrival = sharp(torch.zeros(90))
    assert not meeting_probability(
        arrival, arrival.steps, torch.tensor(50), spread_of(gone=1.0), offsets(90), half_width=HALF
    ).any()


def test_sharp_arrival_and_no_spread_are_the_hard_answer():
    steps = torch.arange(90) * 5 + 2.0
    arrival, offset = sharp(steps), offsets(90) * 2
    time = torch.tensor(205.0)
    hard = meeting_probability(Arrival(steps, steps > 500), steps, time, None, offset, half_width=HALF)
    soft = meeting_probability(arrival, arrival.steps, time, spread_of(scale=1e-9, shape=5.0), offset, half_width=HALF)
    torch.testing.assert_close(soft, hard, atol=1e-6, rtol=0)
    assert hard.unique().tolist() == [0.0, 1.0]


def test_a_goal_that_is_reached_needs_no_distribution():
    arrival = sharp(torch.full((90,), 400.0))
    probability = meeting_probability(
        arrival, torch.zeros(90), torch.tensor(3.0), None, torch.zeros(90, 2), half_width=HALF
    )
    assert bool((probability == 1.0).all())


def test_probability_of_being_there_by_hand():
    bins = torch.tensor([[0.2, 0.3, 0.4, 0.0]])
    arrival = Arrival(torch.zeros(1), torch.zeros(1, dtype=torch.bool), bins, 5)
    for time, expected in ((-3.0, 0.0), (0.0, 0.0), (2.5, 0.1), (5.0, 0.2), (11.0, 0.58), (99.0, 0.9)):
        assert arrival.by(torch.tensor([time])).item() == pytest.approx(expected)


def test_a_distribution_reads_as_the_expectation_does():
    arrival = blurred(4, 3)
    expected = decode_expectation(blurred_logits(4, 3))
    assert torch.equal(arrival.steps, expected.steps)
    assert torch.equal(arrival.never, expected.never)
    torch.testing.assert_close(arrival.bins.sum(-1) < 0.5, arrival.never)


def blurred_robot(blur=3.0):
    """`robot`, with arrival times blurred over the bins."""
    eta, _ = robot()

    def asked(goals, *, estimator):
        steps, never = eta(goals, estimator=estimator)[:2]
        if estimator != "distribution":
            return Arrival(steps, never)
        middle = 5.0 * torch.arange(100, dtype=goals.dtype) + 2.0
        logits = -((middle - steps.unsqueeze(-1)) / (5.0 * blur)).square()
        return decode_distribution(torch.nn.functional.pad(logits, (0, 1), value=-1e4))

    return asked


def search(planner, forecast, here, **more):
    context = SearchContext(tool_pos=torch.zeros_like(here), lost=POCKETED)
    return planner(Forecast(forecast, **more), here, blurred_robot(), context)


def same(one, other):
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_without_caution_the_spread_is_not_read():
    forecast, here = paths(12, dtype=torch.float64)
    same(search(FULL, forecast, here, spread=spread_of(12, gone=0.9)), search(FULL, forecast, here))


def test_a_cautious_search_goes_where_the_forecast_is_sure():
    # The target lies still at two places, one after the other; the first is the longer stay, and unsure.
    forecast = torch.tensor([0.1, 0.0, 0.04]).repeat(90, 1).double()
    forecast[50:, 0] = 0.15
    spread = spread_of(scale=0.001)
    spread.scale[:50] = 0.2
    bold = search(dataclasses.replace(FULL, waiting_cost=0.1), forecast, forecast[0])
    careful = search(dataclasses.replace(CAUTIOUS, waiting_cost=0.1), forecast, forecast[0], spread=spread)
    assert int(bold.arrival_steps) < 50 <= int(careful.arrival_steps)
    assert bool(careful.reachable)


def test_cautious_rows_do_not_see_each_other():
    forecast, here = paths(9, dtype=torch.float64)
    told = Spread(*(part * torch.rand(9, 90, *part.shape[2:]).double() for part in spread_of(9, gone=0.5)))
    whole = search(CAUTIOUS, forecast, here, spread=told)
    order = torch.randperm(9)
    mixed = search(CAUTIOUS, forecast[order], here[order], spread=Spread(*(part[order] for part in told)))
    same(mixed, [part[order] for part in whole])
    single = search(CAUTIOUS, forecast[4], here[4], spread=Spread(*(part[4] for part in told)))
    same(single, [part[4] for part in whole])


@pytest.mark.parametrize("mirror", [(-1.0, 1.0), (1.0, -1.0)])
def test_mirrored_scenes_give_mirrored_cautious_goals(mirror):
    forecast, here = paths(20, dtype=torch.float64)
    told = Spread(*(part * torch.rand(20, 90, *part.shape[2:]).double() for part in spread_of(20)))
    sign = torch.tensor([*mirror, 1.0], dtype=torch.float64)
    whole = search(CAUTIOUS, forecast, here, spread=told)
    mirrored = search(CAUTIOUS, forecast * sign, here * sign, spread=told)
    same(mirrored, whole._replace(goal=whole.goal * sign))


def test_gradients_match_differences():
    logits = torch.randn(3, 101, dtype=torch.float64, requires_grad=True)
    scale = torch.full((3, 2), 0.02, dtype=torch.float64, requires_grad=True)
    offset = torch.tensor([[0.01, -0.02], [0.06, 0.0], [0.03, 0.04]], dtype=torch.float64, requires_grad=True)
    time = torch.tensor([101.3, 57.2, 333.3], dtype=torch.float64, requires_grad=True)

    def probability(logits, scale, offset, time):
        arrival = decode_distribution(logits)
        told = Spread(scale, torch.full_like(scale, 2.0), torch.full_like(time, 0.1))
        return meeting_probability(arrival, arrival.steps.detach(), time, told, offset, half_width=HALF)

    assert torch.autograd.gradcheck(probability, (logits, scale, offset, time))


def late_only(path, goal, steps):
    """Captures nothing within 50 steps, and everything after that."""
    return (steps >= 50).to(goal.dtype).expand(goal.shape[:-1])


def resting(steps=90):
    """A target that rests at one place for 50 steps, then at another one."""
    forecast = torch.tensor([0.1, 0.0, 0.04]).repeat(steps, 1).double()
    forecast[50:, 0] = 0.15
    return forecast


@pytest.mark.parametrize("soft", [False, True])
def test_a_place_at_which_nothing_is_captured_is_left(soft):
    forecast = resting()
    eager = dataclasses.replace(CAUTIOUS, waiting_cost=0.1)
    planner = SoftExactSearch(search=eager, temperature=0.1) if soft else eager
    asked = blurred_robot() if not soft else robot()[0]

    def met(capture):
        context = SearchContext(tool_pos=torch.zeros(3).double(), lost=POCKETED, capture=capture)
        found = planner(Forecast(forecast, spread=spread_of(scale=0.001)), forecast[0], asked, context)
        return float(found.arrival_steps)

    assert met(None) < 50 <= met(FunctionCapture(late_only))
    assert met(FunctionCapture(lambda path, goal, steps: torch.ones_like(goal[..., 0]))) == pytest.approx(met(None))


def test_captures_are_asked_about_the_whole_path_once():
    forecast, here = paths(4, dtype=torch.float64)
    asked = []

    def capture(path, goal, steps):
        asked.append((path, goal, steps))
        return torch.ones_like(goal[..., 0])

    known = {"capture": FunctionCapture(capture), "tool_pos": torch.zeros_like(here)}
    CAUTIOUS(Forecast(forecast), here, blurred_robot(), SearchContext(**known))
    ((path, goal, steps),) = asked
    assert torch.equal(path, torch.cat([here.unsqueeze(-2), forecast], dim=-2))
    candidates = CAUTIOUS.candidates(path)
    assert torch.equal(goal, candidates.goals)
    assert torch.equal(steps, candidates.target_steps)
    FULL(Forecast(forecast), here, robot()[0], SearchContext(**known))
    assert len(asked) == 1
