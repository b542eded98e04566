"""Recorded paths through sensors and a track: what is measured, what is known of it, and what a network is taught."""

import pytest
import torch

from tests.training.rolling import EXTENT, rolling_line, write_paths
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.nets.reflection import reflect
from torchdyn_plan.planners import KalmanTrack
from torchdyn_plan.training.lines import unreflect_paths
from torchdyn_plan.training.sighted_data import SightedSamples, Sighting
from torchdyn_plan.training.sightings import SensorRange, SensorRows, follow, measure, record_sightings
from torchdyn_plan.training.windows import WindowConfig, last_useful_step, load_paths

STEP = 0.004
DRAWING = WindowConfig(history=16, horizon=40, first_step=1)


def draws():
    return torch.Generator().manual_seed(3)


@pytest.fixture
def paths(tmp_path):
    write_paths(tmp_path, lost=())
    return load_paths(tmp_path)


def measured(paths, sensor, steps=200):
    rows = SensorRows.of(sensor, len(paths.length), STEP)
    episodes = torch.arange(len(paths.length))
    return rows, measure(paths, episodes, rows, steps, control_step=STEP, generator=draws())


def test_an_exact_sensor_shows_every_position_at_once(paths):
    _, seen = measured(paths, Sensor())
    torch.testing.assert_close(seen.time, STEP * torch.arange(201.0).expand(12, 201))
    first = paths.start.unsqueeze(-1) + torch.arange(201)
    torch.testing.assert_close(seen.pos, paths.positions[first], atol=1e-6, rtol=0.0)


def test_a_slow_late_sensor_by_hand(paths):
    """At 100 Hz and 9 ms late a measurement of 10 n ms is seen with the first control step from 10 n + 9 ms on."""
    _, seen = measured(paths, Sensor(rate=100.0, latency=0.009), steps=20)
    steps = (~seen.time[0].isnan()).nonzero().flatten().tolist()
    assert steps == [0, 5, 8, 10, 13, 15, 18, 20]
    torch.testing.assert_close(seen.time[0, steps], torch.tensor([0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07]))
    # A measurement between two control steps is of a place between the two.
    here = paths.positions[paths.start]
    between = torch.lerp(paths.positions[paths.start + 2], paths.positions[paths.start + 3], 0.5)
    torch.testing.assert_close(seen.pos[:, 5], between, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(seen.pos[:, 0], here, atol=1e-6, rtol=0.0)


def test_noise_dropout_and_jitter_are_as_large_as_told(paths):
    rows, seen = measured(paths, Sensor(noise=0.005, dropout=0.25, jitter=0.0005), steps=400)
    there = ~seen.time.isnan()
    # Jitter brings now and then two measurements at one step, of which the newest counts.
    assert 0.6 < float(there[:, 1:].float().mean()) < 0.75
    assert there[:, 0].all()
    when = seen.time / STEP
    before = when.nan_to_num().floor().long()
    first = paths.start.unsqueeze(-1)
    old, new = (paths.positions[first + (before + more).clamp(max=419)] for more in (0, 1))
    error = (seen.pos - torch.lerp(old, new, (when.nan_to_num() - before).unsqueeze(-1)))[there]
    assert float(error.std()) == pytest.approx(0.005, rel=0.05)
    late = when - torch.arange(401.0)
    assert float(late[there].std()) > 0.05
    assert float(rows.noise[0]) == pytest.approx(0.005)


def test_a_sensor_that_rounds_is_refused():
    with pytest.raises(InputError, match=r"quantisation, got 0\.001 m"):
        SensorRows.of(Sensor(quantisation=0.001), 3, STEP)


def test_sensors_are_drawn_within_their_range():
    drawn = SensorRange(noise=0.004, slowest=50.0, latency=0.01).draw(4000, draws())
    assert float(drawn.noise.min()) >= 0.0
    assert 0.0035 < float(drawn.noise.max()) <= 0.004
    assert 50.0 <= float(drawn.rate.min()) < 52.0
    assert 240.0 < float(drawn.rate.max()) <= 250.0
    assert float(drawn.latency.max()) <= 0.01
    assert (drawn.jitter <= 0.2 / drawn.rate).all()
    plain = (drawn.latency == 0) & (drawn.jitter == 0) & (drawn.dropout == 0)
    assert 0.2 < float(plain.float().mean()) < 0.3
    with pytest.raises(InputError, match="fastest"):
        SensorRange(slowest=100.0, fastest=50.0)


def test_a_track_is_followed_as_a_loop_does_it(paths):
    track = KalmanTrack(noise=0.003)
    rows, seen = measured(paths, Sensor(noise=0.003, rate=60.0, latency=0.02), steps=60)
    states, covariance, usable = follow(track, seen, rows, control_step=STEP, least_noise=1e-4)
    state = track.start(seen.pos[3, 0])
    for step in range(61):
        now = torch.tensor(step * STEP)
        state = track.add(state, seen.time[3, step], seen.pos[3, step], now)
        for one, all_rows in zip(state, states, strict=True):
            torch.testing.assert_close(one, all_rows[3, step], atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(track.at(state, now).covariance, covariance[3, step])
        assert bool(track.usable(state, now)) == bool(usable[3, step])
    assert not usable[:, 0].any()
    assert usable[:, 20].all()


def test_sightings_of_exact_targets_are_their_own_histories(paths):
    last = last_useful_step(paths, DRAWING)
    seen = record_sightings(
        paths,
        last,
        torch.arange(12),
        KalmanTrack(),
        Sensor(),
        steps=300,
        each=20,
        control_step=STEP,
        least_noise=1e-4,
        generator=draws(),
    )
    assert len(seen.episode) > 200
    assert (seen.present >= 1).all()
    assert (seen.present <= last[seen.episode]).all()
    history = seen.history(8, STEP)
    straight = (seen.present * STEP - seen.state.since) > 8 * STEP
    index = paths.start[seen.episode].unsqueeze(-1) + seen.present.unsqueeze(-1) + torch.arange(-7, 1)
    torch.testing.assert_close(history[straight], paths.positions[index][straight], atol=2e-4, rtol=0.0)
    again = record_sightings(
        paths,
        last,
        torch.arange(12),
        KalmanTrack(),
        Sensor(),
        steps=300,
        each=20,
        control_step=STEP,
        least_noise=1e-4,
        generator=draws(),
    )
    assert torch.equal(seen.present, again.present)
    assert torch.equal(seen.covariance, again.covariance)


def samples(folder, **settings):
    sighting = Sighting(sensors=SensorRange(), steps=200, passes=2, each=8, **settings)
    return SightedSamples.load(folder, DRAWING, 0, sighting, control_step=STEP)


def test_windows_hold_what_was_and_what_will_be(tmp_path, monkeypatch):
    monkeypatch.setattr("torchdyn_plan.training.sighted_data.SCORED", 32)
    write_paths(tmp_path)
    data = samples(tmp_path)
    windows = data.draw(64, draws())
    assert windows.history.shape == (64, 16, 3)
    assert windows.covariance.shape == (64, 2, 2)
    assert windows.seen[1] is windows.covariance
    # A track errs by no more than what it says of itself, and gates.
    error = (windows.history[:, -1] - windows.future[:, 0]).norm(dim=-1)
    assert float(error.median()) < 0.03
    doubt = windows.doubt(STEP)
    assert (doubt.diff(dim=-1) >= -1e-7).all()
    assert (doubt[:, 0] > 0).all()
    regimes = data.regimes(0)
    assert all(len(held.history) <= 32 for held in regimes.values())
    assert "exact" in regimes
    held = data.held_windows(0)
    assert len(held.history) == sum(len(part.history) for part in regimes.values())
    assert not set(data.samples.held.tolist()) & set(data.sightings.episode.tolist())


def test_a_line_goes_on_from_where_the_track_sees_its_target(tmp_path):
    """Late, the track does not know of a bounce: its own line, reflected, is the path all the same."""
    write_paths(tmp_path, lost=())
    paths = load_paths(tmp_path)
    lines = unreflect_paths(paths.positions, paths.start, EXTENT)
    sighting = Sighting(sensors=SensorRange(noise=0.0, slowest=250.0, latency=0.0), steps=300, passes=4, each=64)
    data = SightedSamples.load(tmp_path, DRAWING, 0, sighting, control_step=STEP)
    late = data.record(data.samples.train, Sensor(latency=0.04), 64, draws())
    windows, plain = data.windows(late, lines=lines), data.windows(late)
    torch.testing.assert_close(reflect(windows.future[..., :2], EXTENT), plain.future[..., :2], atol=1e-5, rtol=0)
    ahead = windows.future[:, 0, :2] - windows.history[:, -1, :2]
    extrapolated = windows.history[:, -1, :2].abs().amax(-1) > EXTENT
    assert extrapolated.any()
    assert float(ahead[extrapolated].abs().amax()) < 0.05
    assert float((plain.future[extrapolated, 0, :2] - windows.history[extrapolated, -1, :2]).abs().amax()) > 0.1
    assert float(rolling_line().abs().max()) > EXTENT
