"""Evaluations with a sensor: what is judged is the truth, and what was run tells of it."""

import dataclasses
import json

import pytest
import torch

from tests.evaluation.toy_task import TASK, DriftEnv
from torchdyn_plan import keys
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import evaluate, evaluation
from torchdyn_plan.evaluation.identity import digest_of, identity_of
from torchdyn_plan.evaluation.study import Study
from torchdyn_plan.evaluation.traces import TraceLog

SENSED = dataclasses.replace(
    TASK, make_env=lambda settings, **batch: DriftEnv(drift=settings.drift, control_step=TASK.control_step, **batch)
)
QUIET = {"episodes": 16, "num_envs": 8, "num_threads": 1, "progress": False}
NOISY = Sensor(noise=0.2, rate=2.0)


@pytest.fixture(autouse=True)
def no_plots(monkeypatch):
    monkeypatch.setattr(evaluation, "plot_results", lambda *_: None)


def test_a_noisy_sensor_costs_success_whatever_runs_side_by_side():
    exact = evaluate(SENSED, **QUIET).outcomes["pursuit"]
    noisy = evaluate(SENSED, sensor=NOISY, **QUIET).outcomes["pursuit"]
    again = evaluate(SENSED, sensor=NOISY, **QUIET | {"num_envs": 3}).outcomes["pursuit"]
    assert exact.success.sum() > noisy.success.sum()
    assert torch.equal(noisy.steps, again.steps)


def test_no_sensor_and_an_exact_one_are_one_evaluation_that_says_nothing_of_it():
    configs = [Study.of(SENSED, sensor=sensor, **QUIET).config() for sensor in (None, Sensor())]
    assert configs[0] == configs[1]
    assert "sensor" not in configs[0]
    assert digest_of(identity_of(configs[0])) == digest_of(identity_of(configs[1]))
    other = [Study.of(SENSED, sensor=sensor, **QUIET).config() for sensor in (NOISY, Sensor(noise=0.1))]
    assert len({digest_of(identity_of(config)) for config in [*other, configs[0]]}) == 3


def test_a_folder_tells_its_sensor_and_refuses_another(tmp_path):
    evaluate(SENSED, sensor=NOISY, out=tmp_path, **QUIET)
    config = json.loads((tmp_path / "results.json").read_text())["config"]
    assert config["sensor"] == NOISY.told()
    evaluate(SENSED, sensor=NOISY, out=tmp_path, **QUIET)
    for other in (None, Sensor(noise=0.1)):
        with pytest.raises(InputError, match="another configuration: sensor is"):
            evaluate(SENSED, sensor=other, out=tmp_path, **QUIET)


def test_a_task_that_tells_no_time_of_a_step_can_have_no_sensor():
    evaluate(TASK, sensor=Sensor(), **QUIET)
    with pytest.raises(InputError, match="DriftEnv needs its control_step"):
        evaluate(TASK, sensor=NOISY, **QUIET)


def test_what_is_recorded_for_judging_is_the_truth():
    def record(sensor):
        env = DriftEnv(2, drift=0.03, control_step=TASK.control_step, sensor=sensor, seed=0)
        log, td = TraceLog(env.max_steps), env.reset()
        for _ in range(env.max_steps):
            stepped, td = env.step_and_maybe_reset(td.set(keys.ACTION, torch.zeros(2, 3)))
            log.add(stepped)
        log.end(stepped, torch.arange(2))
        return log.traces()[0].target_pos

    torch.testing.assert_close(record(None), record(NOISY), rtol=0.0, atol=0.0)
