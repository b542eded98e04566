import warnings
from functools import partial

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.planners.toy import NO_MEMORY, ToyEnv, assert_same, make_planner, observation
from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.nets import Actor
from torchdyn_plan.planners import Delayed, EventSchedule, PlanStatus, PolicyPlanner, TargetPursuit
from torchdyn_plan.planners.memory import REPORTED
from torchdyn_plan.tasks import load_task
from torchdyn_plan.tasks.trapper.task import ik_planner


def episodes(data):
    """Outputs of each whole episode in ``data`` (N, T), by its number."""
    result = {}
    for row in data.unbind(0):
        for episode in row["episode"].unique().tolist():
            part = row[row["episode"] == episode]
            if bool(part["next", "done"][-1]):
                result[episode] = part
    return result


def alone(episode, planner=None):
    """The same episode in an environment of its own."""
    return ToyEnv(1, first_episode=episode).rollout(200, planner or make_planner())[0]


def test_auto_resets_at_different_moments_leave_each_episode_as_if_alone():
    data = ToyEnv(5).rollout(400, make_planner(), break_when_any_done=False)
    found = episodes(data)
    assert len(found) > 12
    assert len({len(part) for part in found.values()}) > 5
    for number, part in found.items():
        assert_same(part, alone(number))


def test_memory_survives_step_and_maybe_reset_and_partial_resets_by_hand():
    env, planner = ToyEnv(3), make_planner()
    td, rows = env.reset(), []
    for step in range(150):
        if step in (7, 20, 21):
            td["_reset"] = torch.tensor([[step == 7], [step != 7], [False]])
            td = env.reset(td, select_reset_only=True)
        data, td = env.step_and_maybe_reset(planner(td))
        rows.append(data.clone())
    found = episodes(torch.stack(rows, dim=-1))
    assert len(found) >= 4
    for number, part in found.items():
        assert_same(part, alone(number))


@pytest.mark.parametrize("use_buffers", [False, True])
@pytest.mark.parametrize("primed", [False, True])
def test_memory_survives_a_collector(use_buffers, primed):
    frames = {"frames_per_batch": 4 * 30, "total_frames": 4 * 300}
    settings = {"use_buffers": use_buffers, "auto_register_policy_transforms": primed}
    collector = Collector(lambda: ToyEnv(4), make_planner(), **frames, **settings)
    data = torch.cat([batch.clone() for batch in collector], dim=-1)
    collector.shutdown()
    found = episodes(data)
    assert len(found) > 10
    for number, part in found.items():
        assert_same(part, alone(number))


@pytest.mark.filterwarnings(NO_MEMORY)
def test_a_reset_clears_the_planners_memory_and_leaves_the_static_planners_alone():
    planner, td = make_planner(), observation((2,), step=3)
    td["target_pos"] = td["target_pos"] + 1e4
    planner(td)
    td["plan", "clamped"] = torch.ones(2, dtype=torch.bool)
    td["plan", "path_step"] = torch.arange(2)
    td["step_count"] = torch.tensor([0, 4])
    planner(td)
    memory = {key: value.tolist() for key, value in td["plan"].items()}
    assert memory.pop("goal") == [td["tool_pos"][0].tolist(), td["goal"][1].tolist()]
    assert memory.pop("path") == [[], []]
    assert memory == {
        "window": [12, 10],
        "countdown": [3, 9],
        "replans": [0, 1],
        "arrival_steps": [0, td["arrival_steps"][1]],
        "clamped": [False, True],
        "reachable": [True, False],
        "age": [-1, 1],
        "replanned": [False, False],
        "path_step": [0, 1],
        "status": [PlanStatus.WAITING, PlanStatus.UNREACHABLE],
        "usable": [True, True],
    }


def test_a_rollout_can_be_resumed_from_its_tensordict():
    env, planner = ToyEnv(2), make_planner()
    td = env.reset()
    for _ in range(25):
        td = env.step_mdp(env.step(planner(td)))
    copy = td.clone()
    assert_same(planner(td), make_planner()(copy))
    assert td["plan", "replans"].tolist() == [3, 3]


@pytest.mark.filterwarnings(NO_MEMORY)
def test_an_entry_that_is_absent_in_mid_episode_is_told_and_never_at_the_start():
    planner = make_planner()
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        td = planner(observation((3,), step=0))
        td["step_count"] += 1
        planner(td)
    with pytest.warns(RuntimeWarning, match=r"\('plan', 'window' is absent.*past step 0.*make_tensordict_primer"):
        planner(observation((3,), step=7))
    late = observation((3,), step=0)
    late["step_count"] = torch.tensor([0, 0, 5])
    with pytest.warns(RuntimeWarning, match="the planner's memory is missing"):
        planner(late)
    # What another part has forgotten is told, too, and the plan is kept.
    planner(late)
    late["plan"] = late["plan"].exclude("goal")
    with pytest.warns(RuntimeWarning, match="'goal' is absent"):
        planner(late)


@pytest.mark.parametrize("static", [ik_planner(), PolicyPlanner(Actor(hidden=8), period=3)], ids=["ik", "policy"])
def test_a_static_planner_that_forgets_says_so(static):
    td = TrapperEnv(2, seed=0, num_threads=1).reset()
    pursuit = TargetPursuit(static)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        pursuit(td)
    td["step_count"] += 1
    with pytest.warns(RuntimeWarning, match="the planner's memory is missing"):
        pursuit(td.exclude("plan"))


PARTS = [{}, {"schedule": EventSchedule(first_step=3)}, {"delivery": Delayed(3)}]


def primed(env, planner):
    return TransformedEnv(env, planner.make_tensordict_primer())


def make_primed(make, planner):
    return primed(make(), planner)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("parts", PARTS)
def test_an_environment_that_declares_the_memory_carries_it(parts):
    planner = make_planner(**parts)
    check_env_specs(primed(ToyEnv(2), planner))
    bare = ToyEnv(2).rollout(60, planner, break_when_any_done=False)
    assert_same(primed(ToyEnv(2), planner).rollout(60, planner, break_when_any_done=False), bare)


WORKERS = [(SerialEnv, {}), (ParallelEnv, {"mp_start_method": "fork"})]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("kind", "settings"), WORKERS)
@pytest.mark.parametrize("parts", PARTS)
def test_environments_carry_a_memory_that_is_declared_to_each_of_them(kind, settings, parts):
    planner = make_planner(**parts)
    workers = [partial(ToyEnv, 2, first_episode=0), partial(ToyEnv, 2, first_episode=50)]
    # test_loops declares it to what they are gathered in.
    env = kind(2, [partial(make_primed, make, planner) for make in workers], **settings)
    try:
        data = env.rollout(90, planner, break_when_any_done=False)
    finally:
        env.close()
    for worker, row in zip(workers, data, strict=True):
        assert_same(row, worker().rollout(90, planner, break_when_any_done=False))
    found = episodes(data.flatten(0, 1))
    assert len(found) >= 2


def test_without_a_declaration_other_processes_forget_and_that_is_told():
    env, planner = ParallelEnv(2, partial(ToyEnv, 1), mp_start_method="fork"), make_planner()
    try:
        with pytest.warns(RuntimeWarning, match="make_tensordict_primer"):
            env.rollout(9, planner, break_when_any_done=False)
    finally:
        env.close()


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("kind", "settings"), WORKERS)
def test_the_shipped_planner_plans_as_often_in_other_processes(kind, settings):
    planner = load_task("trapper").planner("wait_and_drop", "ik")
    steps = 23  # plans at steps 3, 8, 13 and 18

    def world(first):
        env = TrapperEnv(1, seed=0, num_threads=1, split="dev")
        env.start_from(first)
        return env

    bare = torch.stack([world(first).rollout(steps, planner, break_when_any_done=False) for first in (0, 9)])
    env = kind(2, [partial(world, 0), partial(world, 9)], **settings)
    try:
        data = primed(env, planner).rollout(steps, planner, break_when_any_done=False)
    finally:
        env.close()
    assert data["plan", "replanned"].sum() == bare["plan", "replanned"].sum() == 2 * 4
    torch.testing.assert_close(data["goal"], bare["goal"])
    torch.testing.assert_close(data["action"], bare["action"], atol=1e-5, rtol=0)


@pytest.mark.parametrize("parts", PARTS)
def test_the_declared_memory_is_the_written_one(parts):
    planner = make_planner(**parts)
    td = planner(observation((2,)))
    empty = planner.empty_memory(td["tool_pos"])
    assert {("plan", name) for name in empty} == {key for key in planner.in_keys if isinstance(key, tuple)}
    for name, value in empty.items():
        assert value.shape == td["plan", name].shape, name
        assert value.dtype == td["plan", name].dtype, name


def test_the_memory_of_a_static_planner_is_declared_too():
    shipped = load_task("trapper").planner("wait_and_drop", "ik")
    statics = ik_planner(), PolicyPlanner(Actor(hidden=8), period=3)
    for planner in (*map(TargetPursuit, statics), *(shipped.with_parts(static=static) for static in statics)):
        td = TrapperEnv(2, seed=0, num_threads=1).reset()
        empty = planner.empty_memory(td["tool_pos"])
        assert set(empty) == set(planner(td)["plan"].keys()) - set(REPORTED)
        assert {("plan", name) for name in empty} == {key for key in planner.in_keys if isinstance(key, tuple)}
        for name, value in empty.items():
            assert (value.shape, value.dtype) == (td["plan", name].shape, td["plan", name].dtype), name
        check_env_specs(primed(TrapperEnv(2, seed=0, num_threads=1), planner))
