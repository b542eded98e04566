"""A track beside its textbook form, and what becomes of measurements that nobody would wish for."""

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics.flight import fly
from torchdyn_plan.planners import BallisticTrack, KalmanTrack, LeastSquaresTrack

KINDS = [
    KalmanTrack(noise=0.005, agility=0.5),
    KalmanTrack(noise=0.005, agility=2.0, accelerates=True),
    LeastSquaresTrack(noise=0.005, window=0.1),
]
ALL = pytest.mark.parametrize("track", KINDS, ids=["velocity", "acceleration", "least squares"])
BAD = float("nan")


def measured(track, times, places, *, now=None, state=None, variance=None):
    """The state after measurements ``places`` (*B, T, 3) at ``times`` (T,), one after the other."""
    state = track.start(places[..., 0, :]) if state is None else state
    for index, moment in enumerate(times.tolist()):
        time = places.new_full(places.shape[:-2], moment)
        present = time if now is None else torch.full_like(time, now)
        state = track.add(state, time, places[..., index, :], present, variance=variance)
    return state


def line(*batch, count=20, step=0.02, noise=0.0, seed=0, dtype=torch.float64):
    """Moments (T,) and places (*B, T, 3) of targets that move straight, their start and their velocity (*B, 3)."""
    draw = torch.Generator().manual_seed(seed)
    start, velocity = torch.randn(2, *batch, 3, generator=draw, dtype=dtype)
    times = step * torch.arange(count, dtype=dtype)
    places = start.unsqueeze(-2) + times.unsqueeze(-1) * velocity.unsqueeze(-2)
    return times, places + noise * torch.randn(places.shape, generator=draw, dtype=dtype), start, velocity


def textbook(n, q, noise, unknown, times, values):
    """The Kalman filter of n integrators along one axis, as in Bar-Shalom: mean (n,) and covariance (n, n)."""
    mean, covariance, last = np.zeros(n), np.diag([noise**2, *np.square(unknown)]), times[0]
    mean[0] = values[0]
    for time, value in zip(times[1:], values[1:], strict=True):
        t, last = time - last, time
        forward = np.array([[1, t, t**2 / 2], [0, 1, t], [0, 0, 1]])[:n, :n]
        drift = {
            2: q * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]]),
            3: q * np.array([[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]]),
        }[n]
        mean, covariance = forward @ mean, forward @ covariance @ forward.T + drift
        sight = np.eye(n)[:1]
        gain = covariance @ sight.T / (sight @ covariance @ sight.T + noise**2)
        mean = mean + gain[:, 0] * (value - mean[0])
        covariance = covariance - gain @ sight @ covariance
    return mean, covariance


@pytest.mark.parametrize("track", KINDS[:2], ids=["velocity", "acceleration"])
def test_it_is_the_textbook_s_kalman_filter(track):
    times, places, _, _ = line(4, noise=0.005)
    times = times + 0.004 * torch.rand(20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    state = measured(track, times, places)
    assert state.restarts.sum() == 0
    n, unknown = track.order, [track.speed, 1.0][: track.order - 1]
    for row in range(4):
        for axis in range(3):
            mean, covariance = textbook(
                n, track.agility**2, 0.005, unknown, times.numpy(), places[row, :, axis].numpy()
            )
            np.testing.assert_allclose(state.motion[row, axis : 3 * n : 3].numpy(), mean, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(state.covariance[row].numpy(), covariance[:2, :2], rtol=1e-9, atol=1e-15)


def test_least_squares_that_forget_nothing_are_a_fitted_line():
    times, places, _, _ = line(noise=0.005)
    state = measured(LeastSquaresTrack(noise=0.005, window=1e9, speed=1e3), times, places)
    slope, level = np.polyfit(times.numpy(), places.numpy(), 1)
    np.testing.assert_allclose(state.velocity.numpy(), slope, rtol=1e-7)
    np.testing.assert_allclose(state.pos.numpy(), level + slope * times[-1].item(), rtol=1e-7)


def test_least_squares_forget_by_their_window():
    times, places, _, _ = line(noise=0.005)
    track = LeastSquaresTrack(noise=0.005, window=0.05, speed=1e3)
    state = measured(track, times, places)
    # A weight of e^(-age/window) is a factor of its root for polyfit, which squares.
    weight = np.exp(-0.5 * (times[-1] - times).numpy() / 0.05)
    slope = np.polyfit(times.numpy(), places.numpy()[:, 0], 1, w=weight)[0]
    np.testing.assert_allclose(state.velocity[0].item(), slope, rtol=1e-5)


@ALL
def test_what_it_says_of_its_error_is_so(track):
    times, places, start, velocity = line(2000, count=30, noise=0.005)
    state = measured(track, times, places)
    error = torch.stack([state.pos - start - times[-1] * velocity, state.velocity - velocity], dim=-1)
    share = error.flatten(0, 1).square().mean(0) / state.covariance[0].diagonal()
    # The target moved straighter than the track allows for: it is rather too cautious.
    assert (share < 1.1).all()
    assert (share > 0.1).all()


@pytest.mark.parametrize("track", [KalmanTrack(noise=0.005, agility=0.0), LeastSquaresTrack(noise=0.005, window=1e9)])
def test_the_order_in_which_measurements_come_does_not_matter(track):
    times, places, _, _ = line(5, noise=0.005)
    order = torch.cat([torch.tensor([0]), 1 + torch.randperm(19, generator=torch.Generator().manual_seed(2))])
    one, other = measured(track, times, places), measured(track, times[order], places[:, order], now=1.0)
    assert (other.used == 20).all()
    torch.testing.assert_close(one.motion, other.motion, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(one.time, other.time)


@ALL
def test_a_late_measurement_makes_it_surer_and_changes_no_clock(track):
    times, places, _, _ = line(noise=0.005)
    without = measured(track, times[torch.arange(20) != 18], places[torch.arange(20) != 18])
    late = measured(track, times[18:19], places[18:19], now=1.0, state=without)
    assert late.time == without.time
    assert late.used == without.used + 1
    assert late.covariance[0, 0] < without.covariance[0, 0]
    whole = measured(track, times, places)
    assert (late.motion - whole.motion)[:6].abs().max() < 0.6 * (without.motion - whole.motion)[:6].abs().max()


@ALL
def test_two_measurements_of_one_moment_count_as_a_better_one(track):
    times, places, _, _ = line(noise=0.005)
    state = measured(track, times[:19], places[:19])
    two = measured(track, times[[19, 19]], torch.stack([places[19] - 0.001, places[19] + 0.001]), state=state)
    one = measured(track, times[19:], places[19:], state=state, variance=0.005**2 / 2)
    torch.testing.assert_close(two.motion, one.motion, rtol=1e-7, atol=1e-10)


@ALL
@pytest.mark.parametrize(
    ("time", "offset", "rejected"),
    [
        (0.40, BAD, 1),
        (0.40, float("inf"), 1),
        (0.40, 1.0, 1),
        (0.90, 0.0, 1),
        (-0.30, 0.0, 1),
        (float("inf"), 0.0, 1),
        (-float("inf"), 0.0, 1),
        (BAD, BAD, 0),
        (BAD, 0.0, 0),
    ],
)
def test_a_measurement_of_no_use_is_counted_and_changes_nothing(track, time, offset, rejected):
    times, places, _, _ = line(3)
    before = measured(track, times, places)
    bad = places[:, -1] + places.new_tensor([[0.0], [offset], [0.0]])
    when = torch.tensor([0.4, time, 0.4], dtype=torch.float64)
    now = torch.full_like(when, 0.4)
    after = track.add(before, when, bad, now)
    for name, old, new in zip(before._fields, before, after, strict=True):
        if name != "rejected":
            assert torch.equal(old[1], new[1]), name
    assert after.rejected.tolist() == [0, rejected, 0]
    # The other rows do not notice.
    alone = track.add(before, now, places[:, -1], now)
    torch.testing.assert_close(after.motion[[0, 2]], alone.motion[[0, 2]], rtol=0.0, atol=0.0)


@ALL
def test_a_bounce_is_seen_at_once_and_the_past_stays(track):
    times = 1 / 30 * torch.arange(12, dtype=torch.float64)
    fold = (times - 0.2).abs()
    places = torch.stack([3.0 * fold, 1.0 * times, 0.0 * times], dim=-1)
    state = measured(track, times[:8], places[:8])
    assert state.restarts == 1
    assert state.velocity[0] > 0.0
    assert state.velocity[1] > 0.8
    state = measured(track, times[8:], places[8:], state=state)
    assert state.restarts == 1
    torch.testing.assert_close(state.velocity, torch.tensor([3.0, 1.0, 0.0], dtype=torch.float64), rtol=0.02, atol=0.02)
    before = torch.tensor([0.1, 0.15, 0.19, 0.3, 0.36], dtype=torch.float64)
    wanted = torch.stack([3.0 * (before - 0.2).abs(), before, 0.0 * before], dim=-1)
    torch.testing.assert_close(state.path(before), wanted, rtol=0.0, atol=0.01)


@ALL
def test_without_measurements_it_is_of_no_use_and_then_begins_anew(track):
    times, places, start, velocity = line(2)
    state = measured(track, times, places)
    now = times[-1].expand(2)
    assert track.usable(state, now + 0.19).all()
    assert not track.usable(state, now + 0.21).any()
    elsewhere = start + 5.0
    state = track.add(state, now + 0.5, elsewhere, now + 0.5)
    assert not track.usable(state, now + 0.5).any()
    assert state.used.tolist() == [1, 1]
    state = track.add(state, now + 0.52, elsewhere + 0.02 * velocity, now + 0.52)
    assert track.usable(state, now + 0.52).all()
    torch.testing.assert_close(state.velocity, velocity, rtol=0.1, atol=0.05)


@ALL
def test_nothing_is_known_before_the_first_measurement(track):
    state = track.start(torch.zeros(2, 3))
    now = torch.zeros(2)
    assert not track.usable(state, now).any()
    assert track.add(state, now * torch.nan, torch.full((2, 3), torch.nan), now).used.sum() == 0
    for entry in track.at(state, now):
        assert entry.isfinite().all()
    assert state.path(now.unsqueeze(-1)).isnan().logical_not().all()


@ALL
def test_it_is_brought_forward_with_less_certainty(track):
    times, places, start, velocity = line(noise=0.001)
    state = measured(track, times, places)
    ahead = track.at(state, times[-1] + 0.1)
    torch.testing.assert_close(ahead.pos, start + (times[-1] + 0.1) * velocity, rtol=0.0, atol=0.02)
    assert ahead.covariance[0, 0] > 1.5 * state.covariance[0, 0]
    back = track.at(state, times[-1] - 0.1)
    assert torch.equal(back.motion, state.motion)


@ALL
def test_the_past_before_the_first_measurement_is_its_place(track):
    times, places, start, velocity = line()
    state = measured(track, times, places)
    path = state.path(torch.tensor([-1.0, -0.004, 0.0, 0.1], dtype=torch.float64))
    torch.testing.assert_close(path[0], path[2])
    torch.testing.assert_close(path[1], path[2])
    torch.testing.assert_close(path[3], start + 0.1 * velocity, rtol=1e-4, atol=1e-4)


@ALL
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_is_its_rows(track, dtype):
    times, places, _, _ = line(2, 3, noise=0.005, dtype=dtype)
    places[0, 1, 7] = torch.nan
    places[1, 2, 9:] += 0.3
    whole = measured(track, times, places)
    assert whole.motion.dtype == dtype
    # One row is computed in 64 bits and stored in those of the track.
    rtol, atol = (1e-9, 1e-12) if dtype == torch.float64 else (3e-4, 1e-5)
    for i in range(2):
        for j in range(3):
            row = measured(track, times, places[i, j])
            for name, one, other in zip(whole._fields, whole, row, strict=True):
                torch.testing.assert_close(one[i, j], other, rtol=rtol, atol=atol, msg=name)


class Operations(TorchDispatchMode):
    """Counts what PyTorch is asked to do: on few rows that is what a track costs."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.count += 1
        return function(*args, **kwargs or {})


@pytest.mark.parametrize(
    ("track", "rows", "most"),
    [(KINDS[0], 2, 36), (KINDS[1], 2, 61), (KINDS[2], 2, 38), *((track, 1, 12) for track in KINDS)],
)
def test_a_measurement_takes_few_operations_and_none_takes_nearly_none(track, rows, most):
    times, places, _, _ = line(rows, noise=0.001)
    state, now = measured(track, times[:-1], places[:, :-1]), times[-1:].expand(rows)
    with Operations() as taken:
        after = track.add(state, now, places[:, -1], now)
    assert (after.used == 20).all()
    assert taken.count <= most
    never = torch.full_like(now, torch.nan)
    with Operations() as nothing:
        assert track.add(state, never, places[:, -1], now) is state
    assert nothing.count <= 2 + rows


@ALL
def test_it_runs_under_vmap(track):
    times, places, _, _ = line(3, noise=0.005, count=5)
    moments = times.expand(3, 5)

    def last(times, places):
        state = track.start(places[0])
        for time, place in zip(times, places, strict=True):
            state = track.add(state, time, place, time)
        return state.motion

    torch.testing.assert_close(torch.vmap(last)(moments, places), measured(track, times, places).motion)


@ALL
@pytest.mark.parametrize("bad", [None, 3], ids=["good", "with a bad measurement"])
def test_it_is_differentiable(track, bad):
    times, places, _, _ = line(count=6)
    now = times[-1]

    def forecast(places, times):
        state = track.start(places[0])
        for index in range(6):
            place, time = places[index], times[index]
            if index == bad:
                place = torch.full_like(place, torch.nan)
            state = track.add(state, time, place, now + 1.0)
        return track.at(state, now + 0.1).pos, state.covariance

    inputs = places.clone().requires_grad_(), times.clone().requires_grad_()
    outputs = forecast(*inputs)
    gradients = torch.autograd.grad(sum(output.sum() for output in outputs), inputs)
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert gradients[0][5].abs().sum() > 0.0
    assert torch.autograd.gradcheck(forecast, inputs)


@pytest.mark.parametrize("passed", [1e3, 1e5, 1e9])
def test_one_target_is_no_error_after_a_very_long_time(passed):
    for track in [*KINDS, LeastSquaresTrack(patience=1e6, window=1e-3)]:
        state = measured(track, *line(count=3)[:2])
        late = torch.tensor(passed, dtype=torch.float64)
        assert track.add(state, late, torch.zeros(3, dtype=torch.float64), late).used >= 1


def test_an_exact_measurement_of_one_target_twice_is_no_error():
    track, zero = KalmanTrack(), torch.zeros(1)
    state = track.start(torch.zeros(1, 3))
    for _ in range(3):
        state = track.add(state, zero, torch.zeros(1, 3), zero, variance=0.0)
    assert state.pos.shape == (1, 3)


def test_derivatives_of_one_target_go_forward_too():
    times, places, _, velocity = line(count=4)

    def last(places):
        return measured(KINDS[0], times, places).pos

    moved = torch.func.jvp(last, (places,), (torch.ones_like(places),))[1]
    torch.testing.assert_close(moved, torch.ones_like(velocity))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: KalmanTrack(noise=0.0), "noise must be >= 1e-06, got 0.0"),
        (lambda: KalmanTrack(agility=-1.0), "agility must be >= 0, got -1.0"),
        (lambda: KalmanTrack(rebound=2.0), r"rebound must be in \[0, 1\], got 2.0"),
        (lambda: KalmanTrack(least=0), "least must be >= 1, got 0"),
        (lambda: LeastSquaresTrack(window=0.0), "window must be >= 1e-06, got 0.0"),
        (lambda: LeastSquaresTrack(patience=BAD), "patience must be a finite number, got nan"),
    ],
)
def test_nonsense_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_shapes_are_checked():
    track, zero = KalmanTrack(), torch.zeros(2)
    state = track.start(torch.zeros(2, 3))
    with pytest.raises(InputError, match=r"pos of a measurement must have shape \(\*B, 2, 3\), got \(2, 2\)"):
        track.add(state, zero, torch.zeros(2, 2), zero)
    with pytest.raises(InputError, match=r"time of a measurement must have shape \(\*B, 2\), got \(3,\)"):
        track.add(state, torch.zeros(3), torch.zeros(3, 3), zero)


DOWN = (0.0, 0.0, -9.81)


def flights(*batch, count, drag=0.0, noise=0.003, step=1 / 60, seed=0):
    """Moments (T,), measured and true places (*B, T, 3), and true velocities of balls that are thrown."""
    draw = torch.Generator().manual_seed(seed)
    start, velocity = torch.randn(2, *batch, 3, generator=draw, dtype=torch.float64)
    velocity = 2.0 * velocity + torch.tensor([-4.0, 0.0, 2.0])
    place, moved = fly(start, velocity, step=step, count=count - 1, gravity=DOWN, drag=drag)
    places = torch.cat([start.unsqueeze(-2), place], dim=-2)
    moved = torch.cat([velocity.unsqueeze(-2), moved], dim=-2)
    times = step * torch.arange(count, dtype=torch.float64)
    return times, places + noise * torch.randn(places.shape, generator=draw, dtype=torch.float64), places, moved


def test_a_ball_that_falls_is_the_textbook_s_filter_of_what_gravity_leaves():
    track = BallisticTrack(noise=0.003, acceleration=0.5, agility=1.0)
    times, measured_at, _, _ = flights(4, count=20)
    state = measured(track, times, measured_at)
    fallen = 0.5 * times[-1] ** 2 * torch.tensor(DOWN, dtype=torch.float64)
    left = measured_at - 0.5 * times.unsqueeze(-1) ** 2 * torch.tensor(DOWN, dtype=torch.float64)
    for row in range(4):
        for axis in range(3):
            mean, covariance = textbook(3, 1.0, 0.003, (3.0, 0.5), times.numpy(), left[row, :, axis].numpy())
            assert abs(state.pos[row, axis] - fallen[axis] - mean[0]) < 1e-9
            assert abs(state.velocity[row, axis] - times[-1] * DOWN[axis] - mean[1]) < 1e-8
            np.testing.assert_allclose(state.covariance[row].numpy(), covariance[:2, :2], rtol=1e-6)


def test_who_knows_gravity_and_expects_drag_knows_a_flight_sooner():
    times, seen, _, moved = flights(400, count=7, drag=0.02)
    kinds = (BallisticTrack(noise=0.003), KalmanTrack(noise=0.003, accelerates=True, acceleration=10.0))
    error = [(measured(track, times, seen).velocity - moved[:, -1]).norm(dim=-1).mean() for track in kinds]
    assert error[0] < 0.1
    assert error[1] > 2.5 * error[0]


def test_a_ball_falls_on_between_and_after_measurements():
    track = BallisticTrack(noise=1e-4, acceleration=1e-3, agility=0.0)
    times, seen, places, _ = flights(3, count=12, noise=0.0)
    state = measured(track, times[:6], seen[:, :6])
    ahead = track.at(state, times.new_full((3,), times[-1].item()))
    torch.testing.assert_close(ahead.pos, places[:, -1], rtol=0.0, atol=2e-3)
    torch.testing.assert_close(state.path(times[:6].expand(3, 6)), places[:, :6], rtol=0.0, atol=1e-3)
    assert (state.restarts == 0).all()


def test_a_ball_that_has_bounced_falls_again():
    """Upwards from the floor, and then as fast down as gravity makes it."""
    track = BallisticTrack(noise=1e-3, rebound=0.8)
    times = 0.01 * torch.arange(40, dtype=torch.float64)
    down = 0.2 - 2.0 * times - 4.905 * times**2
    hits = 0.2 / (1.0 + (1.0 + 0.2 * 9.81 / 2.0) ** 0.5)
    after = times - hits
    up = 0.8 * (2.0 + 9.81 * hits) * after - 4.905 * after**2
    height = torch.where(times < hits, down, up)
    places = torch.stack([times, 0.0 * times, height], dim=-1).unsqueeze(0)
    state = measured(track, times, places)
    assert state.restarts.tolist() == [1]
    torch.testing.assert_close(state.pos[0, 2], height[-1], rtol=0.0, atol=2e-3)
    speed = 0.8 * (2.0 + 9.81 * hits) - 9.81 * after[-1]
    assert (state.velocity[0, 2] - speed).abs() < 0.1


def test_a_ballistic_track_in_a_plane_needs_a_gravity_of_two_numbers():
    time = torch.zeros(2)
    with pytest.raises(InputError, match="gravity has 3 numbers, but targets 2 coordinates"):
        BallisticTrack().add(BallisticTrack().start(torch.zeros(2, 2)), time, torch.zeros(2, 2), time)
    flat = BallisticTrack(gravity=(0.0, -9.81))
    state = flat.add(flat.start(torch.zeros(2, 2)), time, torch.ones(2, 2), time)
    assert flat.at(state, time + 1.0).pos[:, 1].tolist() == pytest.approx([1.0 - 4.905] * 2)
    with pytest.raises(InputError, match="gravity must be two or three numbers"):
        BallisticTrack(gravity=(1.0,))
