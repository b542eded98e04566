import dataclasses

import numpy as np
import pytest
import torch

from torchdyn_plan import keys
from torchdyn_plan.envs import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import evaluate
from torchdyn_plan.planners import Delayed, KalmanTrack, PlanStatus
from torchdyn_plan.tasks import load_task, task_names
from torchdyn_plan.view import Scenario, record_episode
from torchdyn_plan.view.insight import Watch
from torchdyn_plan.view.recording import NOTHING
from torchdyn_plan.view.words import caption, outcome, plan_line

CHASE = load_task("chase")
CAMERA = Sensor(rate=10.0, noise=0.05, latency=0.04)


def chase(planner="meet", **changes):
    return Scenario(task=CHASE, planner=planner, **changes)


@pytest.fixture(scope="module")
def meet():
    return record_episode(chase(episode=2))


def test_a_recording_ends_as_the_episode_of_an_evaluation():
    """A failure with its cause, and a success."""
    settings = CHASE.default_settings(speed=1.4, turning=15.0)
    outcomes = evaluate("chase", ["pursuit"], episodes=3, num_envs=3, progress=False, speed=1.4, turning=15.0).outcomes
    found = outcomes["pursuit"]
    assert found.success[1:].tolist() == [False, True]
    for episode in (1, 2):
        recording = record_episode(chase("pursuit", episode=episode, settings=settings))
        assert recording.success == bool(found.success[episode])
        cause = int(found.cause[episode])
        assert recording.cause == (CHASE.causes[cause] if cause >= 0 else "")
    assert recording.length == int(found.steps[2])


def test_a_planner_that_reads_the_truth_is_shown_it():
    recording = record_episode(chase("oracle", episode=1, settings=CHASE.default_settings(speed=1.4, turning=15.0)))
    assert recording.success
    insight = recording.insights[0]
    np.testing.assert_allclose(insight.path[20], recording.target_pos[insight.begin + 21, :2], atol=1e-5)


def test_places_are_of_space_and_rows_of_every_step(meet):
    count = meet.length + 1
    for name in ("tool_pos", "target_pos", "goal", "believed_pos"):
        assert getattr(meet, name).shape == (count, 3)
    assert (meet.target_pos[:, 2] == 0.0).all()
    moved = np.linalg.norm(np.diff(meet.target_pos, axis=0), axis=1)
    np.testing.assert_allclose(moved, 1.0 * CHASE.control_step, atol=1e-5)
    met = np.linalg.norm(meet.tool_pos - meet.target_pos, axis=1)
    assert met[-1] <= 0.3 < met[:-1].min()
    assert np.isnan(meet.believed_pos).all()
    assert np.isnan(meet.measured_pos).all()


def test_the_countdown_counts_down_between_plans(meet):
    planned = np.diff(meet.replans, prepend=0) > 0
    kept = ~planned[1:-1]
    np.testing.assert_array_equal(np.diff(meet.countdown[:-1])[kept], np.where(meet.countdown[:-2] > 0, -1, 0)[kept])
    assert planned.sum() == len(meet.insights) > 10


def test_slack_says_which_meeting_is_the_first_that_can_be(meet):
    """The planner meets at the first candidate for which it is in time."""
    for step in np.flatnonzero(np.diff(meet.replans, prepend=0) > 0):
        insight = meet.insight(step)
        assert insight.begin == step
        if meet.status[step] == PlanStatus.OK:
            before = insight.target_steps < meet.countdown[step]
            assert (insight.slack[before] < 0.0).all()
            assert insight.slack[~before][0] >= 0.0
        else:
            assert (insight.slack < 0.0).all()


def test_the_region_is_where_the_robot_can_be_in_time(meet):
    insight, planner = meet.insights[0], CHASE.planner("meet")
    state = torch.tensor([[*meet.tool_pos[insight.begin, :2], 0.0, 0.0]], dtype=torch.float32)
    known = planner.eta.from_state(state)(insight.region[None]).steps[0]
    torch.testing.assert_close(insight.region_steps, known)
    assert insight.region.abs().max() == meet.look.half_side


def test_a_watched_planner_does_what_it_does():
    from torchrl.envs.utils import step_mdp

    planner, watched = CHASE.planner("corner"), Watch(CHASE.planner("corner"))
    env = CHASE.make_env(CHASE.default_settings(), num_envs=1, seed=3, split="dev")
    seen = env.reset()
    for step in range(40):
        action = watched.planner(seen.clone())["action"]
        planned = planner(seen)
        assert torch.equal(planned["action"], action)
        insight = watched.insight(seen["robot_state"], torch.zeros(1, 2), step)
        assert (insight is None) == (not bool(planned["plan", "replanned"]))
        watched.planner(planned)
        seen = step_mdp(env.step(planned))


@pytest.mark.parametrize("name", task_names())
def test_a_planner_of_every_task_can_be_watched(name):
    from torchrl.envs.utils import step_mdp

    if name.startswith("fetch"):
        pytest.importorskip("gymnasium_robotics")
    task = load_task(name)
    # The last one that does not need the true future.
    planners = [task.planner(one) for one in task.default_planners]
    watched = Watch([one for one in planners if keys.TARGET_FUTURE not in one.in_keys][-1])
    env = task.make_env(task.default_settings(), num_envs=1, seed=0, split="dev", num_threads=1)
    seen, found = env.reset(), None
    for step in range(16):
        planned = watched.planner(seen)
        found = watched.insight(seen["robot_state"], seen["target_pos"].view(-1, seen["target_pos"].shape[-1]), step)
        if found is not None:
            break
        seen = step_mdp(env.step(planned))
    if watched.planner is watched._inner:
        assert found is not None
        assert not found.slack.isnan().any()
        assert not found.region_steps.isnan().any()


def test_a_delayed_plan_is_of_later():
    recording = record_episode(chase(delivery=Delayed(10), episode=2))
    first = recording.insights[0]
    planned = int(np.flatnonzero(recording.insight_at == 0)[0])
    assert first.begin == planned + 10
    np.testing.assert_allclose(first.path[0], recording.target_pos[first.begin + 1, :2], atol=1e-4)


def test_a_planner_without_plans_has_none():
    recording = record_episode(chase("pursuit", episode=2))
    assert not recording.insights
    assert set(recording.status) == {NOTHING}
    np.testing.assert_array_equal(recording.goal[:-1], recording.target_pos[:-1])
    assert plan_line(recording, 3) == "makes no plans"


def test_measurements_and_track_are_kept():
    held = record_episode(chase("corner", sensor=CAMERA, episode=2))
    tracked = record_episode(chase("corner", sensor=CAMERA, track=KalmanTrack(noise=0.05), episode=2))
    for recording in (held, tracked):
        came = np.isfinite(recording.measured_pos).all(-1).any(-1)
        assert came.sum() == pytest.approx(recording.length * CHASE.control_step * CAMERA.rate, abs=2)
    late = np.linalg.norm(held.believed_pos - held.target_pos, axis=1)[60:-1]
    filtered = np.linalg.norm(tracked.believed_pos - tracked.target_pos, axis=1)[60:150]
    assert filtered.mean() < 0.5 * np.nanmean(late)


def test_words_count_down_and_end(meet):
    step = int(np.flatnonzero(meet.status == PlanStatus.OK)[0])
    seconds = meet.countdown[step] * CHASE.control_step
    assert caption(meet, step) == f"{step * CHASE.control_step:.2f} s  meets in {seconds:.2f} s, in time"
    assert caption(meet, meet.length) == outcome(meet) == f"met after {meet.length * CHASE.control_step:.2f} s"
    failed = dataclasses.replace(meet, success=False, cause="early_contact")
    assert outcome(failed).endswith(": early contact")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"episode": -1}, "episode"),
        ({"episode": 2.5}, "episode"),
        ({"seed": -1}, "seed"),
        ({"planner": "dream"}, "dream"),
        ({"static": "walk"}, "walk"),
        ({"split": "train"}, "train"),
    ],
)
def test_what_cannot_be_is_said(changes, words):
    with pytest.raises(InputError, match=words):
        record_episode(Scenario(**({"task": CHASE, "planner": "meet"} | changes)))


def test_progress_may_end_a_recording():
    class EnoughError(Exception):
        pass

    steps = []

    def count(step):
        steps.append(step)
        if step == 7:
            raise EnoughError

    with pytest.raises(EnoughError):
        record_episode(chase(), count)
    assert steps == list(range(1, 8))
