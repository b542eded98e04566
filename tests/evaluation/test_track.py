"""Evaluations with a track between sensor and planner: chosen by name, told in what was run, its gates counted."""

import dataclasses
import json
import math
import typing

import pytest
import torch

from tests.evaluation.test_sensor import QUIET, SENSED
from torchdyn_plan.cli.arguments import TrackArguments
from torchdyn_plan.cli.forms import TRACKS as NAMES
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import evaluate, evaluation
from torchdyn_plan.evaluation import sweep as sweeping
from torchdyn_plan.evaluation.identity import digest_of, identity_of
from torchdyn_plan.evaluation.results import EpisodeOutcomes
from torchdyn_plan.evaluation.study import Study
from torchdyn_plan.evaluation.tracks import LEAST_NOISE, NO_TRACK, TRACKS, track_named
from torchdyn_plan.planners import KalmanTrack, LeastSquaresTrack, TrackedPlanner

NOISY = Sensor(noise=0.05, rate=2.0)
TRACK = LeastSquaresTrack(noise=NOISY.noise, window=2.0, speed=0.2, max_speed=1.0, patience=2.0, oldest=1.0)
"""The toy's control step is a tenth of a second, and its target drifts."""


@pytest.fixture(autouse=True)
def no_plots(monkeypatch):
    monkeypatch.setattr(evaluation, "plot_results", lambda *_: None)
    monkeypatch.setattr(sweeping, "plot_sweep", lambda *_: None)


def test_a_track_wins_back_what_the_sensor_costs():
    how = QUIET | {"episodes": 32, "drift": 0.03}
    held = evaluate(SENSED, sensor=NOISY, **how).outcomes["pursuit"]
    tracked = evaluate(SENSED, sensor=NOISY, track=TRACK, **how).outcomes["pursuit"]
    again = evaluate(SENSED, sensor=NOISY, track=TRACK, **how | {"num_envs": 3}).outcomes["pursuit"]
    assert tracked.success.sum() > 2 * held.success.sum()
    assert torch.equal(tracked.steps, again.steps)
    assert all(torch.equal(tracked.track[name], again.track[name]) for name in tracked.track)


def test_no_track_says_nothing_and_each_track_is_another_evaluation():
    tracks = [None, TRACK, KalmanTrack(), KalmanTrack(gate=3.0)]
    configs = [Study.of(SENSED, sensor=NOISY, track=track, **QUIET).config() for track in tracks]
    assert "track" not in configs[0]
    assert configs[1]["track"]["kind"] == "LeastSquaresTrack"
    assert configs[1]["track"]["window"] == 2.0
    assert len({digest_of(identity_of(config)) for config in configs}) == 4


def test_a_folder_tells_its_track_and_refuses_another(tmp_path):
    evaluate(SENSED, sensor=NOISY, track=TRACK, out=tmp_path, **QUIET)
    config = json.loads((tmp_path / "results.json").read_text())["config"]
    assert config["track"] == TRACK.told()
    evaluate(SENSED, sensor=NOISY, track=TRACK, out=tmp_path, **QUIET)
    # Without a track the planner is another one; nothing is said then of what there is not.
    for other, named in ((None, "weights of pursuit"), (dataclasses.replace(TRACK, gate=3.0), "track")):
        with pytest.raises(InputError, match=f"another configuration: {named} is"):
            evaluate(SENSED, sensor=NOISY, track=other, out=tmp_path, **QUIET)


def test_what_the_track_made_of_measurements_is_in_rows_files_and_table(tmp_path):
    # Nothing moves as fast as this noise jumps: many measurements are of no use.
    slow = dataclasses.replace(TRACK, noise=0.01, max_speed=0.05)
    found = evaluate(SENSED, sensor=NOISY, track=slow, out=tmp_path, **QUIET)
    outcomes, row = found.outcomes["pursuit"], found.rows[0]
    assert set(outcomes.track) == set(row.track) == {"used", "restarts", "rejected"}
    assert outcomes.track["rejected"].sum() > 0
    assert row.track["rejected"] == pytest.approx(float(outcomes.track["rejected"].double().mean()))
    # At two measurements a second an episode of 40 steps of 0.1 s has no more than nine of them.
    assert ((outcomes.track["used"] + outcomes.track["rejected"]) <= 9).all()
    written = json.loads((tmp_path / "results.json").read_text())["rows"][0]
    assert written["track"] == row.track
    episodes = json.loads((tmp_path / "episodes.json").read_text())["pursuit"]
    assert episodes["track_rejected"] == outcomes.track["rejected"].tolist()
    again = EpisodeOutcomes.from_json(episodes, SENSED)
    assert torch.equal(again.track["used"], outcomes.track["used"])
    assert "track rejected" in found.table()
    plain = evaluate(SENSED, sensor=NOISY, **QUIET)
    assert plain.rows[0].track == {}
    assert "track" not in plain.table()


def test_a_sweep_goes_through_the_track(tmp_path):
    how = {"over": "drift", "values": (0.0, 0.02), "repeats": 2, "sensor": NOISY}
    rows = sweeping.sweep(SENSED, track=TRACK, out=tmp_path, **how, **QUIET)
    assert all(row.track["used"] > 1 for row in rows)
    assert json.loads((tmp_path / "sweep.json").read_text())["track"] == TRACK.told()
    with pytest.raises(InputError, match="another configuration"):
        sweeping.sweep(SENSED, out=tmp_path, **how, **QUIET)


def test_a_planner_that_has_a_track_or_can_have_none_is_refused():
    planner = SENSED.planner("pursuit")
    tracked = TrackedPlanner(planner, TRACK, control_step=SENSED.control_step)
    with pytest.raises(InputError, match="planner 'mine' already has a track"):
        evaluate(SENSED, {"mine": tracked}, track=TRACK, **QUIET)
    with pytest.raises(InputError, match="planner 'mine' is not a planner of this package"):
        evaluate(SENSED, {"mine": lambda td: td}, track=TRACK, **QUIET)


def test_a_named_track_is_told_the_sensors_noise():
    assert track_named("none") is None
    grain = Sensor(noise=0.003, quantisation=0.004 * math.sqrt(12.0))
    assert track_named("kalman", grain).noise == pytest.approx(0.005)
    assert track_named("kalman", Sensor()).noise == track_named("kalman").noise == LEAST_NOISE
    own = track_named("least_squares", grain, noise=0.1, window=0.3)
    assert own == LeastSquaresTrack(noise=0.1, window=0.3)


def test_the_command_line_has_every_track_and_each_of_their_settings():
    assert set(NAMES) == {NO_TRACK, *TRACKS}
    shown = typing.get_type_hints(TrackArguments)
    known = {name: kind for track in TRACKS.values() for name, kind in typing.get_type_hints(track).items()}
    fields = {one.name for track in TRACKS.values() for one in dataclasses.fields(track)}
    assert set(shown) == fields
    assert all(shown[name] == known[name] | None for name in fields)
