"""A planner behind a track: what it is shown, what it is spared, and what is said of rows without a track."""

import pytest
import torch
from tensordict import TensorDict

from tests.planners.toy import HISTORY, ToyEnv, assert_same, make_planner, observation
from torchdyn_plan import keys
from torchdyn_plan.envs import Sensor, TrapperEnv
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners import (
    CallablePlanner,
    Delayed,
    DynamicPlanner,
    KalmanTrack,
    PlanStatus,
    PointPlanner,
    ReplanSchedule,
    TargetPursuit,
    TrackedPlanner,
)

STEP = 0.01
TRACK = KalmanTrack(noise=1e-4)
BAD = float("nan")


def tracked(planner=None, track=TRACK):
    planner = make_planner(schedule=ReplanSchedule.every(5, first_step=3)) if planner is None else planner
    return TrackedPlanner(planner, track, control_step=STEP, history=HISTORY)


def play(planner, env, steps, change=lambda td, step: td):
    """What ``planner`` makes of each step, ``change`` being done to what it sees before."""
    seen, td = [], env.reset()
    for step in range(steps):
        td = planner(change(td, step))
        seen.append(td.clone())
        td = env.step_and_maybe_reset(td)[1]
    return torch.stack(seen)


def test_with_exact_measurements_it_plans_as_the_planner_alone():
    one = play(make_planner(schedule=ReplanSchedule.every(5, first_step=3)), ToyEnv(5), 60)
    other = play(tracked(), ToyEnv(5), 60)
    torch.testing.assert_close(one[keys.GOAL], other[keys.GOAL], rtol=0.0, atol=0.01)
    assert torch.equal(one["plan", "replans"], other["plan", "replans"])
    assert torch.equal(one[keys.STEP_COUNT], other[keys.STEP_COUNT])
    known = one[keys.STEP_COUNT] > 0
    assert torch.equal(one["plan", "status"][known], other["plan", "status"][known])
    assert (other["plan", "status"][~known] == int(PlanStatus.NO_TRACK)).all()


def test_what_is_read_of_the_target_is_left_as_it_was():
    td = observation((3,))
    before = td.clone()
    after = tracked()(td)
    for key in before.keys():  # noqa: SIM118
        assert torch.equal(after[key], before[key]), key
    assert keys.TARGET_COVARIANCE not in after.keys()  # noqa: SIM118


def test_the_planner_is_shown_the_target_of_now_and_its_past():
    shown = {}

    class Spy(TargetPursuit):
        def forward(self, tensordict):
            shown.update({key: tensordict[key].clone() for key in (keys.TARGET_POS, keys.TARGET_HISTORY)})
            shown[keys.TARGET_COVARIANCE] = tensordict[keys.TARGET_COVARIANCE].clone()
            return super().forward(tensordict)

    planner = tracked(Spy(CallablePlanner(lambda state, goal: goal - state)))
    memory, velocity = None, torch.tensor([1.0, -2.0, 0.0])
    for step in range(12):
        # Measurements are two steps old, and lost at times.
        time = torch.tensor([STEP * (step - 2) if step >= 2 and step % 3 else BAD])
        td = observation((1,), step=step)
        td[keys.MEASURED_TIME], td[keys.MEASURED_POS] = time.unsqueeze(0), (time.unsqueeze(-1) * velocity).unsqueeze(0)
        if memory is not None:
            td[keys.PLAN] = memory
        memory = planner(td)[keys.PLAN]
    wanted = STEP * torch.arange(12 - HISTORY, 12).clamp_min(0).unsqueeze(-1) * velocity
    torch.testing.assert_close(shown[keys.TARGET_HISTORY][0], wanted, rtol=0.0, atol=1e-3)
    assert torch.equal(shown[keys.TARGET_POS], shown[keys.TARGET_HISTORY][:, -1])
    assert (torch.linalg.eigvalsh(shown[keys.TARGET_COVARIANCE]) > 0.0).all()
    torch.testing.assert_close(memory["track_age"], torch.tensor([2 * STEP]))
    assert memory["track_deviation"] > 0.0


def test_rows_without_a_track_say_so_and_hold_and_the_others_do_not_notice():
    def lose(td, step):
        time = STEP * td[keys.STEP_COUNT].float().unsqueeze(1)
        time[1] = BAD
        time[2, 0] = BAD if step > 20 else time[2, 0]
        pos = td[keys.TARGET_POS].unsqueeze(1).clone()
        pos[3] = BAD if step > 25 else pos[3]
        return td.set(keys.MEASURED_TIME, time).set(keys.MEASURED_POS, pos)

    seen, alone = play(tracked(), ToyEnv(4, max_steps=999), 60, lose), play(tracked(), ToyEnv(4, max_steps=999), 60)
    status, none = seen["plan", "status"], int(PlanStatus.NO_TRACK)
    assert status[0].tolist() == [none] * 4
    assert (status[:, 1] == none).all()
    assert (status[1:20, [0, 2, 3]] != none).all()
    assert (status[47:, [1, 2, 3]] == none).all()
    assert (seen["plan", "track_rejected"][-1] == torch.tensor([0, 0, 0, 34])).all()
    for row in (1, 2, 3):
        assert torch.equal(seen[keys.GOAL][50, row], seen[keys.TOOL_POS][50, row])
        assert seen[keys.ACTION][50:, row].abs().max() == 0.0
    assert_same(seen[:, 0].exclude("target_pos"), alone[:, 0].exclude("target_pos"))
    assert seen[keys.ACTION].isfinite().all()


def test_a_track_that_comes_back_goes_on():
    def gap(td, step):
        time = STEP * td[keys.STEP_COUNT].float().unsqueeze(1)
        time = time * BAD if 20 <= step < 50 else time
        return td.set(keys.MEASURED_TIME, time).set(keys.MEASURED_POS, td[keys.TARGET_POS].unsqueeze(1))

    seen = play(tracked(), ToyEnv(2, max_steps=999), 70, gap)
    lost = seen["plan", "status"] == int(PlanStatus.NO_TRACK)
    assert lost[45:50].all()
    begun = seen[keys.STEP_COUNT] == 0
    assert not (lost & ~begun)[52:].any()
    assert (seen["plan", "replans"][-1] > seen["plan", "replans"][49]).all()


def test_episodes_begin_afresh_and_memory_of_no_use_is_forgotten():
    planner = tracked()
    td = planner(observation((3,)))
    td[keys.STEP_COUNT] = torch.tensor([0, 1, 1])
    td[keys.PLAN, "track_motion"][2] = BAD
    count = planner(td)["plan", "track_used"]
    assert count.tolist() == [1, 2, 1]


def test_a_long_run_through_resets_is_one_run_for_each_episode():
    env = ToyEnv(3, max_steps=30)
    seen = play(tracked(), env, 90)
    fresh = seen[keys.STEP_COUNT] == 0
    assert fresh.sum() > 6
    assert (seen["plan", "track_used"][fresh] == 1).all()
    assert (seen["plan", "track_restarts"] <= 1).all()


def test_it_can_be_carried_by_a_primer():
    entries = tracked().empty_memory(torch.zeros(2, 3))
    assert entries["track_motion"].shape == (2, 9)
    written = {key[1] for key in tracked().out_keys if isinstance(key, tuple)}
    assert written >= set(entries)


def test_it_is_saved_with_its_planner(tmp_path):
    inner = DynamicPlanner.from_pretrained("trapper-ik")
    planner = TrackedPlanner(inner, KalmanTrack(noise=0.003), control_step=0.004)
    planner.save_pretrained(tmp_path)
    again = TrackedPlanner.from_pretrained(tmp_path)
    assert again.track == planner.track
    assert isinstance(again.planner, DynamicPlanner)
    assert again.scene == planner.scene == inner.scene
    for one, other in zip(planner.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(one, other)


def test_the_planner_inside_can_be_changed():
    planner = tracked()
    late = planner.with_planner(planner.planner.with_parts(delivery=Delayed(2)))
    assert late.track is planner.track
    seen = play(late, ToyEnv(3), 20)
    assert ("plan", "pending_left") in late.out_keys or seen["plan", "replans"].max() > 0
    assert isinstance(planner.for_inference(), TrackedPlanner)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: TrackedPlanner(make_planner(), "kalman", control_step=STEP),
            "track must be a Track such as .* got str",
        ),
        (lambda: TrackedPlanner(print, TRACK, control_step=STEP), "planner must be a planner of this package"),
        (lambda: TrackedPlanner(make_planner(), TRACK, control_step=0.0), "control_step must be >= 1e-06, got 0.0"),
        (lambda: tracked()(TensorDict({}, [2])), "TrackedPlanner reads the key 'target_pos'"),
    ],
)
def test_nonsense_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_measurements_of_a_wrong_shape_are_named():
    td = observation((2,))
    td[keys.MEASURED_TIME], td[keys.MEASURED_POS] = torch.zeros(2, 1), torch.zeros(2, 1, 2)
    with pytest.raises(InputError, match=r"measured_pos must have shape \(\*B, 2, 1, 3\), got \(2, 1, 2\)"):
        tracked()(td)


def test_the_history_is_as_long_as_the_forecaster_reads():
    planner = make_planner()
    planner.forecaster.history = 7
    assert TrackedPlanner(planner, TRACK, control_step=STEP).history == 7
    assert TrackedPlanner(make_planner(), TRACK, control_step=STEP).history == 24
    assert tracked(planner).history == HISTORY


def test_a_static_planner_with_a_variant_for_noise_is_exchanged_alone():
    inner = DynamicPlanner.from_pretrained("trapper-ik")
    seeing = TrackedPlanner(inner, KalmanTrack(noise=0.005), control_step=0.004).planner
    assert seeing.static.damping == inner.static.noisy_damping
    assert (seeing.forecaster, seeing.schedule) == (inner.forecaster, inner.schedule)


def test_a_persons_own_static_planner_may_have_a_variant_for_noise():
    class Hasty(PointPlanner):
        def for_noise(self, noise):
            return self if noise < 0.01 else slow

    limits = {"acceleration": 1.0, "control_step": STEP}
    slow, planner = PointPlanner(speed=0.1, **limits), DynamicPlanner(Hasty(speed=1.0, **limits))
    assert planner.for_noise(0.001) is planner
    assert planner.for_noise(0.02).static is slow


def test_the_planner_that_ships_sees_noisy_targets_by_another_forecaster(tmp_path):
    """From the second measurement on; saved and loaded it is the same, and without noise it is the planner itself."""
    inner = DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop")
    exact = TrackedPlanner(inner, KalmanTrack(noise=1e-4), control_step=0.004)
    assert exact.planner is inner
    assert exact.history == 24
    planner = TrackedPlanner(inner, KalmanTrack(noise=0.005), control_step=0.004)
    assert planner.planner.forecaster is inner.forecaster.noisy
    assert planner.planner.static.damping > inner.static.damping
    assert planner.history == 48
    planner.save_pretrained(tmp_path)
    loaded = TrackedPlanner.from_pretrained(tmp_path)
    sensor = Sensor(noise=0.005, rate=125.0)
    rolls = []
    for made in (planner, loaded):
        env = TrapperEnv(num_envs=2, velocity=3.0, seed=0, split="dev", sensor=sensor, num_threads=1)
        with torch.no_grad():
            rolls.append(env.rollout(6, made, break_when_any_done=False))
    assert torch.equal(rolls[0]["action"], rolls[1]["action"])
    status = rolls[0]["plan", "status"]
    assert (status[:, :2] == int(PlanStatus.NO_TRACK)).all()
    assert rolls[0]["plan", "replans"][:, 1].sum() == 0
    assert (rolls[0]["plan", "replans"][:, 2] == 1).all()
