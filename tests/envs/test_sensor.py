"""What a sensor does to a target, in the smallest world, whose targets fly at a known speed."""

import dataclasses

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from tests.envs.points import PointEnv
from torchdyn_plan import keys
from torchdyn_plan.envs import DynamicReachEnv, Sensor, TrapperEnv
from torchdyn_plan.errors import InputError

STEP, SPEED = 0.004, 0.002
"""Time of a control step [s], and how far a target flies in it [m]."""
ALL = Sensor(rate=60.0, noise=0.005, latency=0.02, jitter=0.003, dropout=0.05, quantisation=0.001)


class Endless(PointEnv):
    """Nothing ends an episode but its steps."""

    def _terminated(self, observed):
        return torch.zeros(self.num_envs, 1, dtype=torch.bool)


def watch(sensor, steps=200, num_envs=3):
    """What is seen of targets at 1 … ``steps`` control steps, ``(N, steps)``."""
    env = Endless(num_envs, speed=SPEED, control_step=STEP, sensor=sensor, max_steps=500, seed=5)
    return env.rollout(steps, break_when_any_done=False)["next"]


def measurements(seen):
    """Times (K,) and errors (K, 3) of all measurements of the first row."""
    time, pos = seen[keys.MEASURED_TIME][0], seen[keys.MEASURED_POS][0]
    came = ~time.isnan()
    steps = torch.arange(1, len(time) + 1).unsqueeze(-1).expand_as(time)[came]
    truth = seen[keys.TRUE_TARGET_POS][0]
    start = truth[0] - torch.tensor([SPEED, 0.0, 0.0])
    there = start + (time[came] / STEP * SPEED).unsqueeze(-1) * torch.tensor([1.0, 0.0, 0.0])
    return time[came], pos[came] - there, steps


@pytest.mark.parametrize("sensor", [None, Sensor()])
def test_an_exact_sensor_changes_nothing(sensor):
    torch.manual_seed(0)
    plain = PointEnv(3, speed=SPEED, seed=5).rollout(20)
    torch.manual_seed(0)
    seen = PointEnv(3, speed=SPEED, seed=5, control_step=STEP, sensor=sensor).rollout(20)
    assert set(plain.keys(True)) == set(seen.keys(True))
    for key in (keys.TARGET_POS, keys.TARGET_HISTORY, keys.OBSERVATION):
        assert torch.equal(plain["next", key], seen["next", key])


@pytest.mark.parametrize("sensor", [ALL, Sensor(rate=30.0), Sensor(noise=0.001, rate=600.0), Sensor(jitter=0.004)])
def test_specs_hold(sensor):
    check_env_specs(PointEnv(3, control_step=STEP, sensor=sensor))


def test_noise_is_as_large_as_told_and_of_no_axis_alone():
    _, error, _ = measurements(watch(Sensor(noise=0.003), steps=499))
    assert error.mean(0).abs().max() < 0.0006
    torch.testing.assert_close(error.std(0), torch.full((3,), 0.003), rtol=0.1, atol=0.0)


def test_the_rate_says_when_measurements_are_taken_and_the_latency_when_they_come():
    time, error, steps = measurements(watch(Sensor(rate=30.0, latency=0.010)))
    torch.testing.assert_close(time, (torch.arange(len(time)) + 1) / 30.0)
    assert error.abs().max() < 3e-5
    assert torch.equal(steps, torch.ceil((time + 0.010) / STEP - 1e-4).long())


def test_between_measurements_the_last_one_is_held():
    seen = watch(Sensor(rate=30.0), steps=50)
    pos, truth = seen[keys.TARGET_POS][0], seen[keys.TRUE_TARGET_POS][0]
    assert len(pos[:, 0].unique()) == 1 + 6
    assert (truth[:, 0] - pos[:, 0]).max() > 7 * SPEED
    history = seen[keys.TARGET_HISTORY][0]
    assert torch.equal(history[30], pos[30 - 23 : 31])


def test_jitter_scatters_the_moments():
    time, error, _ = measurements(watch(Sensor(rate=50.0, jitter=0.002), steps=499))
    off = time - (torch.arange(len(time)) + 1) / 50.0
    assert 0.0015 < off.std() < 0.0025
    assert error.abs().max() < 3e-5


def test_dropout_loses_its_share():
    count = int((~watch(Sensor(dropout=0.3), steps=499)[keys.MEASURED_TIME].isnan()).sum())
    assert 0.63 < count / (3 * 499) < 0.77


def test_quantisation_rounds():
    pos = watch(Sensor(quantisation=0.01), steps=50)[keys.TARGET_POS]
    torch.testing.assert_close(pos, (pos * 100).round() / 100)
    assert len(pos[0, :, 0].unique()) > 3


def test_a_faster_sensor_than_the_loop_shows_all_that_came():
    time, error, steps = measurements(watch(Sensor(rate=500.0), steps=100))
    assert len(time) == 200
    assert torch.equal(steps.bincount()[1:], torch.full((100,), 2))
    assert error.abs().max() < 3e-5


@pytest.mark.parametrize("num_envs", [1, 2, 5])
def test_an_episode_is_measured_alike_whatever_runs_beside_it_and_whoever_resets(num_envs):
    def episodes(count):
        env = PointEnv(count, speed=SPEED, control_step=STEP, sensor=ALL, max_steps=20, seed=3)
        env.start_from(0)
        found, td = {}, env.reset()
        for _ in range(200):
            for row, episode in enumerate(td[keys.EPISODE].tolist()):
                found.setdefault(episode, []).append(td[keys.TARGET_POS][row])
            td["action"] = torch.zeros(count, 3)
            td = env.step_and_maybe_reset(td)[1]
        return {episode: torch.stack(places) for episode, places in found.items()}

    one, other = episodes(5), episodes(num_envs)
    for episode in range(5):
        length = min(len(one[episode]), len(other[episode]))
        assert length > 1
        assert torch.equal(one[episode][:length], other[episode][:length]), episode


def test_a_row_that_resets_leaves_the_measurements_of_others_alone():
    env = PointEnv(2, speed=SPEED, control_step=STEP, sensor=Sensor(rate=30.0, latency=0.02, noise=0.01), seed=1)
    td = env.reset()
    td["action"] = torch.zeros(2, 3)
    for _ in range(9):
        td = env.step_and_maybe_reset(td.set("action", torch.zeros(2, 3)))[1]
    before = td[keys.TARGET_HISTORY][1].clone()
    td["_reset"] = torch.tensor([[True], [False]])
    after = env.reset(td)
    assert torch.equal(after[keys.TARGET_HISTORY][1], before)
    assert (after[keys.TARGET_HISTORY][0] == after[keys.TARGET_POS][0]).all()
    assert after[keys.MEASURED_TIME][0, 0] == 0.0


def test_rewards_and_flags_go_by_the_truth():
    exact = TrapperEnv(8, velocity=5.0, seed=2, split="dev", max_steps=200)
    noisy = TrapperEnv(8, velocity=5.0, seed=2, split="dev", max_steps=200, sensor=Sensor(noise=0.1))
    action = torch.zeros(8, 6)
    one, other = exact.reset(), noisy.reset()
    pocketed = 0
    for _ in range(150):
        one = exact.step(one.set("action", action))["next"]
        other = noisy.step(other.set("action", action))["next"]
        assert torch.equal(one[keys.TARGET_POS], other[keys.TRUE_TARGET_POS])
        assert not torch.equal(one[keys.TARGET_POS], other[keys.TARGET_POS])
        assert torch.equal(one["pocketed"], other["pocketed"])
        pocketed += int(one["pocketed"].sum())
    assert pocketed > 0


def test_every_task_takes_a_sensor():
    env = DynamicReachEnv(2, sensor=Sensor(noise=0.01))
    td = env.rollout(5)["next"]
    assert not torch.equal(td[keys.TARGET_POS], td[keys.TRUE_TARGET_POS])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rate": 0.0}, r"rate must be in \[1, 10000\], got 0.0"),
        ({"noise": -1.0}, r"noise must be in \[0, 10\], got -1.0"),
        ({"noise": float("nan")}, "noise must be a finite number, got nan"),
        ({"dropout": 1.5}, r"dropout must be in \[0, 1\], got 1.5"),
        ({"latency": "late"}, "latency must be a finite number, got 'late'"),
    ],
)
def test_nonsense_is_named(wrong, message):
    with pytest.raises(InputError, match=message):
        Sensor(**wrong)


def test_a_sensor_needs_a_moving_target_and_the_time_of_a_step():
    with pytest.raises(InputError, match="sensor must be None with static_target"):
        TrapperEnv(static_target=True, sensor=Sensor(noise=0.1))
    with pytest.raises(InputError, match="PointEnv needs its control_step"):
        PointEnv(sensor=Sensor(noise=0.1))
    with pytest.raises(InputError, match="sensor must be a Sensor or None, got float"):
        PointEnv(sensor=0.1, control_step=STEP)


def test_a_sensor_is_told_number_by_number():
    assert ALL.told() == dataclasses.asdict(ALL)
    assert Sensor().is_exact
    assert not ALL.is_exact
