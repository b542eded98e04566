"""Forecasts by mechanics beside motions worked out step by step."""

import math

import pytest
import torch

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.flight import fly
from torchdyn_plan.nets import Ballistic, Billiard, ConstantVelocity
from torchdyn_plan.nets.analytic import normal_spread

STEP, HALF = 0.004, 0.7
KINDS = [
    ConstantVelocity(horizon=50),
    Ballistic(horizon=50),
    Ballistic(horizon=50, drag=0.05),
    Billiard(HALF, horizon=50),
    Billiard(HALF, horizon=50, restitution=1.0, deceleration=0.02, sliding=0.5, gaps=[(0.3, 0.5)]),
]
ALL = pytest.mark.parametrize(
    "model", KINDS, ids=["straight", "flight", "flight with drag", "billiard", "billiard with all"]
)


def history(place, velocity, count=24):
    """Positions (*B, count, 3) of targets that come to ``place`` with ``velocity``, straight."""
    ago = STEP * torch.arange(1 - count, 1, dtype=place.dtype).unsqueeze(-1)
    return place.unsqueeze(-2) + ago * velocity.unsqueeze(-2)


def simulated(place, velocity, seconds, *, half=(HALF, HALF), e=1.0, drag=0.0, fine=20):
    """A ball that is rolled in small steps and mirrored at each cushion, at every control step (T, 3)."""
    place, velocity, found = place.clone(), velocity.clone(), []
    small = STEP / fine
    for index in range(round(seconds / STEP) * fine):
        place = place + small * velocity * (1.0 - 0.5 * drag * small)
        velocity = velocity * math.exp(-drag * small)
        for axis in (0, 1):
            if place[axis].abs() > half[axis]:
                over = place[axis].abs() - half[axis]
                place[axis] = place[axis].sign() * (half[axis] - e * over)
                velocity[axis] = -e * velocity[axis]
        if (index + 1) % fine == 0:
            found.append(place.clone())
    return torch.stack(found)


def test_a_target_goes_on():
    place, velocity = torch.randn(2, 5, 3, dtype=torch.float64).unbind(0)
    path = ConstantVelocity(horizon=40).predict(history(place, velocity)).path
    torch.testing.assert_close(path[:, 39], place + 40 * STEP * velocity)
    torch.testing.assert_close(path[:, 0], place + STEP * velocity)


def test_a_target_falls():
    time = STEP * torch.arange(-23, 61, dtype=torch.float64).unsqueeze(-1)
    flight = (
        torch.tensor([0.1, 0.2, 1.5])
        + time * torch.tensor([2.0, -1.0, 3.0])
        - 0.5 * 9.81 * time**2 * (torch.tensor([0.0, 0.0, 1.0]))
    )
    path = Ballistic(horizon=60).predict(flight[:24]).path
    torch.testing.assert_close(path, flight[24:])


def test_a_target_is_slowed_down_by_the_air():
    start, velocity = torch.tensor([[3.0, 0.1, 1.5], [-6.0, 0.4, 2.0]], dtype=torch.float64)
    law = {"gravity": (0.0, 0.0, -9.81), "drag": 0.04}
    flight, _ = fly(start, velocity, step=STEP, count=180, **law)
    path = Ballistic(horizon=150, drag=0.04).predict(flight[:30]).path
    torch.testing.assert_close(path, flight[30:], rtol=0.0, atol=1e-5)
    without = Ballistic(horizon=150).predict(flight[:30]).path
    assert (without - flight[30:])[-1].norm() > 0.1


@pytest.mark.parametrize("e", [1.0, 0.9, 0.5])
@pytest.mark.parametrize("velocity", [(2.0, 1.0, 0.0), (-5.0, 4.9, 0.0), (0.0, -3.0, 0.0), (0.3, 0.0, 0.0)])
def test_a_ball_is_mirrored_again_and_again(e, velocity):
    place, velocity = torch.tensor([0.1, -0.3, 0.04], dtype=torch.float64), torch.tensor(velocity, dtype=torch.float64)
    path = Billiard(HALF, restitution=e, horizon=300).predict(history(place, velocity)).path
    wanted = simulated(place, velocity, 1.2, e=e)
    torch.testing.assert_close(path, wanted, rtol=0.0, atol=1e-6)
    assert path[:, :2].abs().max() <= HALF


def test_a_puck_on_air_loses_its_speed_on_an_oblong_table():
    place = torch.tensor([0.5, -0.3, 0.04], dtype=torch.float64)
    velocity = torch.tensor([-2.5, 1.1, 0.0], dtype=torch.float64)
    model = Billiard((0.9, 0.4), restitution=0.8, drag=0.5, horizon=300)
    path = model.predict(history(place, velocity)).path
    wanted = simulated(place, velocity, 1.2, half=(0.9, 0.4), e=0.8, drag=0.5)
    torch.testing.assert_close(path, wanted, rtol=0.0, atol=1e-5)
    assert (path[:, :2].abs().amax(0) <= torch.tensor([0.9, 0.4])).all()
    again = type(model)(**model.part_settings()).predict(history(place, velocity)).path
    torch.testing.assert_close(again, path, rtol=0.0, atol=0.0)


def test_a_ball_slows_down_and_stops():
    place, velocity = torch.tensor([-0.6, 0.0, 0.0], dtype=torch.float64), torch.tensor([0.5, 0.0, 0.0])
    model = Billiard(HALF, deceleration=0.5, sliding=0.5, horizon=300)
    path = model.predict(history(place, velocity.double())).path
    assert abs(path[-1, 0] - (-0.6 + 0.5**2 / (2 * 0.5))) < 1e-6
    time = 0.4
    assert abs(path[99, 0] - (-0.6 + 0.5 * time - 0.25 * time**2)) < 1e-6


def test_a_ball_that_slides_is_known_by_its_history_and_slides_after_a_bounce():
    model = Billiard(HALF, deceleration=0.01, sliding=0.5, restitution=0.9, horizon=200)
    time = STEP * torch.arange(-23, 61, dtype=torch.float64)
    x = -0.5 + 2.0 * time - 0.25 * time**2
    slides = torch.stack([x, 0.0 * x, 0.0 * x], dim=-1)
    # A position of one step ago lags by half a step: half of what is lost in it.
    torch.testing.assert_close(model.predict(slides[:24]).path[:60], slides[24:], rtol=0.0, atol=3e-4)
    rolls = history(torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64), torch.tensor([2.0, 0.0, 0.0]).double())
    path = model.predict(rolls).path[:, 0]
    steps = torch.diff(path) / STEP
    assert steps[:40].min() > 1.98
    lost = (steps[60] - steps[160]) / (100 * STEP)
    assert abs(-lost - 0.5 * steps[60].abs() / (0.9 * 2.0)) < 0.05


def test_a_gap_swallows_the_ball():
    model = Billiard(HALF, gaps=[(0.3, 0.5)], gone_height=-0.2, horizon=200)
    place = torch.tensor([[0.0, 0.4, 0.04], [0.0, 0.0, 0.04], [0.0, 0.3, 0.04]])
    forecast = model.predict(history(place, torch.tensor([2.0, 0.0, 0.0]).expand(3, 3)))
    meets = round(HALF / (2.0 * STEP))
    heights, gone = forecast.path[..., 2], forecast.spread.gone
    assert (heights[0, : meets - 2] > 0.0).all()
    assert (heights[0, meets + 2 :] == -0.2).all()
    assert (heights[1] > 0.0).all()
    assert gone[0, -1] > 0.99
    assert gone[1, -1] < 0.01
    assert 0.3 < gone[2, -1] < 0.7
    assert (torch.diff(gone) >= 0.0).all()


def test_the_spread_is_that_of_a_normal_distribution_where_it_matters():
    spread = normal_spread(torch.full((1, 1, 2), 0.02))
    torch.testing.assert_close(spread.interval(0.5), torch.full((1, 1, 2), 0.6744898 * 0.02))
    torch.testing.assert_close(spread.interval(0.95), torch.full((1, 1, 2), 1.959964 * 0.02))


def test_the_spread_of_a_noisy_history_holds_as_much_as_it_says():
    draw = torch.Generator().manual_seed(0)
    place, velocity = 0.1 * torch.randn(2, 4000, 3, generator=draw)
    noisy = history(place, velocity) + 0.001 * torch.randn(4000, 24, 3, generator=draw)
    forecast = ConstantVelocity(horizon=100, noise=0.001, acceleration=0.0).predict(noisy)
    truth = place.unsqueeze(1) + STEP * torch.arange(1, 101).unsqueeze(-1) * velocity.unsqueeze(1)
    for share in (0.5, 0.95):
        inside = ((forecast.path - truth)[..., :2].abs() <= forecast.spread.interval(share)).float().mean((0, 2))
        assert (inside - share).abs().max() < 0.02


def test_a_track_tells_how_sure_it_is():
    model = ConstantVelocity(horizon=100, tracked=True, acceleration=0.0)
    assert model.in_keys == (keys.TARGET_HISTORY, keys.TARGET_COVARIANCE)
    covariance = torch.tensor([[4e-6, 1e-6], [1e-6, 1e-4]])
    spread = model.predict(torch.zeros(24, 3), covariance).spread
    time = 0.4
    wanted = (4e-6 + 2 * time * 1e-6 + time**2 * 1e-4) ** 0.5
    torch.testing.assert_close(spread.interval(0.95)[99], torch.full((2,), 1.959964 * wanted))


@ALL
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_a_batch_is_its_rows_in_their_type(model, batch, dtype):
    draw = torch.Generator().manual_seed(0)
    place, velocity = 0.4 * torch.randn(2, *batch, 3, generator=draw)
    seen = history(place, velocity).to(dtype)
    whole = model.predict(seen)
    assert whole.path.shape == (*batch, 50, 3)
    assert whole.path.dtype == dtype
    assert whole.spread.scale.shape == (*batch, 50, 2)
    assert whole.spread.gone.shape == (*batch, 50)
    rows = [model.predict(row).path for row in seen.reshape(-1, 24, 3)]
    torch.testing.assert_close(whole.path.reshape(-1, 50, 3), torch.stack(rows), rtol=0.0, atol=1e-5)


@ALL
def test_it_is_differentiable_also_at_rest(model):
    place = torch.tensor([[0.2, 0.3, 0.1], [0.0, 0.0, 0.0]], dtype=torch.float64)
    seen = history(place, torch.tensor([[1.0, -0.5, 0.1], [0.0, 0.0, 0.0]], dtype=torch.float64)).requires_grad_()
    forecast = model.predict(seen)
    (forecast.path.sum() + forecast.spread.scale.sum() + forecast.spread.gone.sum()).backward()
    assert seen.grad.isfinite().all()
    assert seen.grad.abs().sum() > 0.0
    moving = seen.detach()[:1].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda value: model.predict(value).path[..., :2], moving, eps=1e-8, atol=1e-4)


@ALL
def test_it_is_told_by_its_settings(model):
    again = type(model)(**model.part_settings())
    assert again.part_settings() == model.part_settings()
    seen = torch.randn(3, 24, 3, generator=torch.Generator().manual_seed(1))
    assert torch.equal(again.predict(seen).path, model.predict(seen).path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ConstantVelocity(horizon=0), "horizon must be >= 1, got 0"),
        (lambda: Ballistic(gravity=(1.0,)), r"gravity must be two or three numbers, got \(1.0,\)"),
        (lambda: Ballistic(drag=-0.1), "drag must be >= 0, got -0.1"),
        (lambda: Billiard(0.0), "half_extent must be >= 1e-09, got 0.0"),
        (lambda: Billiard(1.0, restitution=1.2), r"restitution must be in \[0.01, 1\], got 1.2"),
        (
            lambda: Billiard((1.0, 0.5, 0.5)),
            "half_extent must be one number or two",
        ),
        (lambda: Billiard(1.0, drag=0.5, sliding=0.1), "a table has drag or decelerations, got 0.5, 0 and 0.1"),
        (lambda: Billiard(1.0, gaps=[(0.5, 0.2)]), r"gaps must be pairs that rise within ±1, got \(0.5, 0.2\)"),
        (lambda: ConstantVelocity().predict(torch.zeros(3, 24, 4)), "target_history must have shape"),
        (
            lambda: ConstantVelocity(tracked=True).predict(torch.zeros(3, 24, 3), torch.zeros(3, 3)),
            "target_covariance must have shape",
        ),
    ],
)
def test_nonsense_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()
