import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.cushions import fold
from torchdyn_plan.planners.adaptation import Adaptation, Course, slow_down

HORIZON = 200
ADAPTATION = Adaptation()


def rolling(speed, drag, *, steps=HORIZON, start=(0.1, -0.2), extent=None):
    """Positions (steps + 1, 3) of a target that starts with ``speed`` (2,) and brakes by ``drag`` along each axis."""
    time = torch.arange(steps + 1, dtype=torch.float64).unsqueeze(-1)
    speed, start = torch.tensor(speed, dtype=torch.float64), torch.tensor(start, dtype=torch.float64)
    rolls = torch.minimum(time, speed.abs() / drag) if drag > 0 else time
    level = start + speed * rolls - 0.5 * drag * speed.sign() * rolls.square()
    if extent is not None:
        level = fold(level, extent)
    return torch.cat([level, torch.full_like(time, 0.042)], dim=-1)


def forecasts(truth, speeds):
    """What a forecaster that knows of no drag says at each step of ``truth``: straight on with the present speed."""
    time = torch.arange(1, HORIZON + 1, dtype=torch.float64).unsqueeze(-1)
    for now, speed in zip(truth, speeds, strict=True):
        level = now[:2] + time * speed
        yield torch.cat([level, torch.full_like(time, 0.042)], dim=-1)


def learn(truth, speeds, every=5, adaptation=ADAPTATION):
    """Course and corrected forecast after plans at every ``every``-th step of ``truth``."""
    course = adaptation.start(truth[0])
    for step, forecast in enumerate(forecasts(truth, speeds)):
        if step % every == 0:
            corrected, course = adaptation.adapt(forecast, truth[step], course)
        course = course._replace(course_age=course.course_age + 1)
    return corrected, course


@pytest.mark.parametrize("drag", [2e-5, 8e-6, -5e-6])
def test_a_constant_drag_is_found_and_the_forecast_comes_true(drag):
    speed = (0.008, -0.005)
    truth = rolling(speed, drag, steps=51 + HORIZON)
    time = torch.arange(51).unsqueeze(-1)
    speeds = torch.tensor(speed) - drag * torch.tensor(speed).sign() * time
    corrected, course = learn(truth[:51], speeds)
    assert ADAPTATION.drag(course.drags).item() == pytest.approx(drag, rel=1e-4)
    horizon = 100
    error = (corrected - truth[51 : 51 + HORIZON])[:horizon, :2].abs().amax()
    uncorrected = next(forecasts(truth[50:51], speeds[50:51]))
    was = (uncorrected - truth[51 : 51 + HORIZON])[:horizon, :2].abs().amax()
    assert error < 0.03 * was


def test_without_errors_the_forecast_is_the_same_to_the_bit():
    path = rolling((0.01, 0.004), 0.0, steps=40 + HORIZON, extent=0.3).float()
    course = ADAPTATION.start(path[0])
    for step in range(0, 40, 5):
        forecast = path[step + 1 : step + 1 + HORIZON]
        corrected, course = ADAPTATION.adapt(forecast, path[step], course)
        assert torch.equal(corrected, forecast)
        course = course._replace(course_age=course.course_age + 5)


def test_one_surprise_or_few_estimates_change_nothing():
    quiet = torch.full((8, 2), torch.nan)
    quiet[:4] = torch.tensor([1e-8, -1e-8])
    loud = quiet.clone()
    loud[4] = 4e-5
    few = torch.full((8, 2), torch.nan)
    few[0], few[1, 0] = 2e-5, 2e-5
    assert ADAPTATION.drag(torch.stack([quiet, loud, few])).tolist() == [0.0, 0.0, 0.0]
    few[1, 1] = 1e-5
    assert ADAPTATION.drag(few).item() == pytest.approx(2e-5)


def test_the_drag_is_the_quartile_nearer_to_zero():
    drags = torch.arange(1.0, 17.0).reshape(8, 2)
    assert ADAPTATION.drag(drags).item() == 5.0
    assert ADAPTATION.drag(-drags).item() == -5.0
    assert Adaptation(quartile=0.0).drag(drags).item() == 1.0


@pytest.mark.parametrize("case", ["turned", "slow", "young", "old", "far", "sunk"])
def test_what_proves_nothing_is_not_judged(case):
    course = rolling((0.01, 0.01), 0.0, steps=15)[:, :2].clone()
    age, target = torch.tensor(10), torch.tensor([*(course[10] - 1e-4), 0.042])
    assert bool((ADAPTATION.observe(course, age, target) > 0).all())
    if case == "turned":
        course[6:, 0] = course[5, 0] - 0.01 * torch.arange(10)
    elif case == "slow":
        course[:, 0] = course[0, 0] + 1e-4 * torch.arange(16)
    elif case in ("young", "old"):
        age = torch.tensor({"young": 2, "old": 16}[case])
    elif case == "far":
        target[0] -= 0.01
    else:
        target[2] = -0.01
    found = ADAPTATION.observe(course, age, target)
    assert bool(found[0].isnan())
    assert bool(found[1].isnan()) == (case in ("young", "old", "sunk"))


def test_a_target_stops_and_stays_where_its_speed_is_spent():
    path = rolling((0.004, 0.0), 0.0)
    slower = slow_down(path, torch.tensor(4e-5, dtype=torch.float64))
    assert slower[-1, 0] - path[0, 0] == pytest.approx(0.5 * 0.004**2 / 4e-5, rel=0.03)
    assert torch.equal(slower[105:, 0], slower[105, 0].expand(HORIZON - 105))
    assert bool((slower[:, 0].diff() >= 0).all())
    assert bool((slower[:, 1] == path[0, 1]).all())


def test_drag_goes_on_beyond_a_bounce():
    extent, drag = 0.3, 1e-5
    path = rolling((0.008, 0.005), 0.0, extent=extent)
    truth = rolling((0.008, 0.005), drag, extent=extent)[1:]
    slower = slow_down(path, torch.tensor(drag, dtype=torch.float64))
    assert bool((truth[:150, 0].diff() < 0).any())
    assert (slower - truth)[:150].abs().amax() < 0.1 * (path[1:] - truth)[:150].abs().amax()


def batch(dtype=torch.float64):
    torch.manual_seed(0)
    speed = 0.02 * torch.rand(6, 1, 2, dtype=dtype) - 0.01
    time = torch.arange(HORIZON + 1, dtype=dtype).unsqueeze(-1)
    level = fold(torch.rand(6, 1, 2, dtype=dtype) - 0.5 + speed * time, 0.6)
    path = torch.cat([level, 0.1 * torch.rand(6, HORIZON + 1, 1, dtype=dtype)], -1)
    drags = 1e-5 * torch.rand(6, 8, 2, dtype=dtype)
    course = torch.flip(path[:, :16, :2], (1,)) + 1e-5
    return path[:, 1:], path[:, 0], Course(course, torch.arange(2, 8), drags)


def test_rows_do_not_see_each_other_and_batches_are_free():
    forecast, now, course = batch()
    whole, after = ADAPTATION.adapt(forecast, now, course)
    order = torch.randperm(6)
    mixed, _ = ADAPTATION.adapt(forecast[order], now[order], Course(*(part[order] for part in course)))
    assert torch.equal(mixed, whole[order])
    shaped, again = ADAPTATION.adapt(
        forecast.unflatten(0, (2, 3)), now.unflatten(0, (2, 3)), Course(*(part.unflatten(0, (2, 3)) for part in course))
    )
    assert torch.equal(shaped.flatten(0, 1), whole)
    assert torch.equal(again.drags.flatten(0, 1).nan_to_num(-1), after.drags.nan_to_num(-1))
    single, _ = ADAPTATION.adapt(forecast[3], now[3], Course(*(part[3] for part in course)))
    assert torch.equal(single, whole[3])


@pytest.mark.parametrize("mirror", [(-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
def test_mirrored_courses_give_mirrored_forecasts(mirror):
    forecast, now, course = batch()
    sign = torch.tensor([*mirror, 1.0], dtype=torch.float64)
    whole, _ = ADAPTATION.adapt(forecast, now, course)
    mirrored, _ = ADAPTATION.adapt(forecast * sign, now * sign, course._replace(course=course.course * sign[:2]))
    assert torch.equal(mirrored, whole * sign)


def test_gradients_match_differences():
    path = rolling((0.008, 0.005), 0.0, steps=60)[None].requires_grad_()
    drag = torch.tensor([7.3e-6], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: slow_down(path.detach(), d)[:, ::11, :2], drag, eps=1e-10, atol=1e-3)
    slow_down(path, drag).sum().backward()
    assert bool(path.grad.isfinite().all())


@pytest.mark.parametrize(
    "settings",
    [{"memory": 0}, {"least": 0}, {"quartile": 0.6}, {"oldest": 2}, {"largest": -1.0}, {"smooth": -1}],
)
def test_wrong_settings_are_named(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        Adaptation(**settings)


def test_a_wrong_forecast_is_named():
    _, now, course = batch()
    with pytest.raises(InputError, match="forecast"):
        ADAPTATION.adapt(torch.zeros(5, 10, 3), now, course)
