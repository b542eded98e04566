import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets import Arrival, ETANetwork, FunctionArrival
from torchdyn_plan.nets.distributions import decode_distribution


def distributions(count=5, seed=0):
    """Arrivals (count, 7) with a probability of every bin."""
    draw = torch.Generator().manual_seed(seed)
    return decode_distribution(3 * torch.randn(count, 7, 41, generator=draw, dtype=torch.float64))


def times(arrival):
    return [torch.full_like(arrival.steps, time) for time in (-3.0, 0.0, 0.5, 4.0, 17.0, 100.0, 205.0, 1e4)]


@pytest.mark.parametrize("steps", [0, 1, 5, 13, 400])
def test_what_is_counted_later_is_the_same_distribution_shifted(steps):
    arrival = distributions()
    later = arrival.after(steps)
    assert torch.equal(later.bins, arrival.bins)
    assert torch.equal(later.never, arrival.never)
    for time in times(arrival):
        torch.testing.assert_close(later.by(time), arrival.by(time + steps))
    torch.testing.assert_close(later.steps, (arrival.steps - steps).clamp_min(0.0))
    assert bool((later.steps >= 0.0).all())


def test_shifts_add_up():
    arrival = distributions()
    twice, once = arrival.after(4).after(9), arrival.after(13)
    torch.testing.assert_close(twice.steps, once.steps)
    for time in times(arrival):
        assert torch.equal(twice.by(time), once.by(time))


def test_a_distribution_rises_from_0_to_the_probability_of_arriving():
    arrival = distributions()
    by = torch.stack([arrival.by(torch.full_like(arrival.steps, time)) for time in range(-5, 300)])
    assert bool((by.diff(dim=0) >= 0.0).all())
    assert not by[:6].any()
    torch.testing.assert_close(by[-1], arrival.bins.sum(-1))


def test_a_time_without_a_distribution_is_certain():
    arrival = Arrival(torch.tensor([4.0, 9.0, 4.0]), torch.tensor([False, False, True]))
    assert arrival.by(torch.tensor(6)).tolist() == [1.0, 0.0, 0.0]
    assert arrival.after(4).by(torch.tensor([0, 4, 9])).tolist() == [1.0, 0.0, 0.0]
    assert arrival.after(4).by(torch.tensor([0, 5, 9])).tolist() == [1.0, 1.0, 0.0]
    assert arrival.after(7).steps.tolist() == [0.0, 2.0, 0.0]


def test_a_function_of_state_and_goal_may_stand_in():
    def far(robot_state, goal):
        steps = (goal - robot_state).norm(dim=-1)
        return steps.masked_fill(steps > 5.0, torch.inf)

    model = FunctionArrival.wrap(far)
    goal = torch.tensor([[[0.0, 0.0, 3.0], [0.0, 0.0, 9.0]]])
    for arrival in (model.arrival(torch.zeros(1, 1, 3), goal), model.from_state(torch.zeros(1, 3))(goal)):
        assert arrival.steps.tolist() == [[3.0, torch.inf]]
        assert arrival.never.tolist() == [[False, True]]
    told = Arrival(torch.ones(1, 2), torch.zeros(1, 2, dtype=torch.bool))
    assert FunctionArrival.wrap(lambda *_: told).arrival(torch.zeros(1, 1, 3), goal) is told


def test_a_model_is_taken_as_it_is_and_what_cannot_be_called_is_refused():
    network = ETANetwork(hidden=8)
    assert FunctionArrival.wrap(network) is network
    with pytest.raises(InputError, match=r"eta must be an ArrivalModel or a function.*got 3"):
        FunctionArrival.wrap(3)
