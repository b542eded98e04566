from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from tests.bench.columns import COLUMNS
from torchdyn_plan.bench import env as bench_env
from torchdyn_plan.bench.tape import RawSimulation, TapedBatch
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.episodes import EpisodeLog, play
from torchdyn_plan.planners import TargetPursuit
from torchdyn_plan.tasks import load_task

TASK = load_task("trapper")


def pursuit(task=TASK):
    return TargetPursuit(task.static_planner(chunk=16))


def test_mujoco_alone_repeats_the_loop_bit_for_bit_through_resets():
    rows = bench_env.bench(TASK, planners={"pursuit": pursuit()}, sizes=(3,), steps=500, threads=1)
    assert [(row["what"], row["implementation"]) for row in rows] == [
        ("random", "mujoco.batch"),
        ("random", "TrapperEnv"),
        ("pursuit", "mujoco.batch"),
        ("pursuit", "evaluation loop"),
    ]
    for row in rows:
        assert row.keys() >= COLUMNS | {"share_of_raw", "env_steps_per_second"}
        assert row["max_error"] == 0.0
        assert (row["batch"], row["threads"]) == (3, 1)
    assert rows[0]["share_of_raw"] == rows[2]["share_of_raw"] == 1.0


def test_a_simulation_with_mocap_bodies_and_state_that_is_written_is_repeated_too():
    pytest.importorskip("gymnasium_robotics")
    task = load_task("fetch_reach")
    rows = bench_env.bench(task, planners={"pursuit": pursuit(task)}, sizes=(2,), steps=60, threads=1)
    assert {row["implementation"] for row in rows} == {"mujoco.batch", "DynamicReachEnv", "evaluation loop"}
    assert all(row["max_error"] == 0.0 for row in rows)


def test_a_tape_holds_every_reset():
    env, taped = bench_env.taped_env(TASK, 6, 1)
    log = EpisodeLog.empty(60, TASK, env)
    loop = play(pursuit(), env, log)
    for _ in range(330):
        next(loop)
    assert log.done.any()
    calls = taped.take()
    assert sum(call.name == "step" for call in calls) == 330
    resets = sum(len(call.arguments[0]) for call in calls if call.name == "reset")
    assert resets == 6 + int(log.done.sum())
    assert taped.take() == []


def test_recording_is_no_part_of_what_the_loop_takes():
    _, taped = bench_env.taped_env(TASK, 2, 1)
    before = taped.seconds
    taped.step(nstep=1)
    assert taped.seconds > before
    assert taped.nsim == 2


@pytest.mark.parametrize("missing", [{"written": None}, {"inputs": ()}])
def test_a_tape_that_lacks_something_shows_as_an_error(monkeypatch, missing):
    play_all = RawSimulation.play

    def without(self, calls):
        play_all(self, [call._replace(**missing) for call in calls])

    monkeypatch.setattr(RawSimulation, "play", without)
    rows = bench_env.bench(TASK, planners={"pursuit": pursuit()}, sizes=(2,), steps=5, threads=1)
    assert all(row["max_error"] > 0.0 for row in rows)


def test_an_environment_without_a_batch_is_refused():
    empty = replace(TASK, make_env=lambda settings, **batch: SimpleNamespace())
    with pytest.raises(InputError, match=r"simulation\.batch, but SimpleNamespace has none"):
        bench_env.taped_env(empty, 1)


def test_planners_are_the_task_s_own_by_name():
    made = bench_env._planners(TASK, ["pursuit"])
    assert list(made) == ["pursuit"]
    assert list(bench_env._planners(TASK, None)) == ["pursuit", "corner"]
    without = replace(TASK, planners={"wait": TASK.planners["wait"]})
    assert list(bench_env._planners(without, None)) == ["wait"]


def test_a_taped_batch_answers_as_the_batch_does():
    env, taped = bench_env.taped_env(TASK, 2, 1)
    assert isinstance(taped, TapedBatch)
    env.reset()
    assert torch.equal(torch.from_numpy(taped.bind("qpos")), env.simulation.qpos)
