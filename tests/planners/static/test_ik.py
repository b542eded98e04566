import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from tests.planners.follower import APPROACH, DOUBLE, MIDDLE, SCENE, after, goals, home, observe
from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.planners import IKPlanner, TargetPursuit
from torchdyn_plan.tasks.trapper.task import ik_planner


def test_it_is_a_tensordict_module_that_says_what_it_reads_and_writes():
    planner, td = ik_planner(), observe(home(3), MIDDLE)
    assert isinstance(planner, TensorDictModuleBase)
    before = set(td.keys(include_nested=True, leaves_only=True))
    planner(td)
    written = set(td.keys(include_nested=True, leaves_only=True)) - before
    assert written == set(planner.out_keys)
    assert set(planner.in_keys) == before | {key for key in written if isinstance(key, tuple)}


def test_actions_of_five_steps_are_one_path_whatever_the_arm_does_meanwhile():
    planner, td = ik_planner(), observe(home(2), MIDDLE)
    expected = planner.path(td["joint_pos"], td["goal"])
    for step in range(5):
        td["joint_pos"], td["step_count"] = home(2, spread=0.1 * step), torch.full((2,), step)
        planner(td)
        assert torch.equal(td["action"], expected[:, step])
    td["joint_pos"], td["step_count"] = home(2, spread=0.2), torch.full((2,), 5)
    assert torch.equal(planner(td)["action"], planner.path(td["joint_pos"], td["goal"])[:, 0])


def test_a_changed_goal_flushes_the_path_in_its_row_alone():
    planner, td = ik_planner(), observe(home(3), MIDDLE)
    kept = planner.path(td["joint_pos"], planner(td)["goal"])
    td["step_count"], td["joint_pos"] = torch.ones(3, dtype=torch.int64), home(3, spread=0.05)
    td["goal"] = MIDDLE + torch.tensor([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, 0.0, 0.3]])
    planner(td)
    anew = planner.path(td["joint_pos"], td["goal"])
    assert torch.equal(td["action"][0], kept[0, 1])
    torch.testing.assert_close(td["action"][1:], anew[1:, 0])
    assert td["plan", "path_step"].tolist() == [2, 1, 1]


def test_rows_at_step_zero_start_afresh():
    planner, td = ik_planner(), observe(home(2), MIDDLE)
    kept = planner.path(td["joint_pos"], planner(td)["goal"])
    td["step_count"], td["joint_pos"] = torch.tensor([0, 1]), home(2, spread=0.05)
    planner(td)
    torch.testing.assert_close(td["action"][0], planner.path(td["joint_pos"][:1], td["goal"][:1])[0, 0])
    assert torch.equal(td["action"][1], kept[1, 1])
    assert td["plan", "path_step"].tolist() == [1, 2]


def test_memory_of_an_earlier_step_is_never_written_to():
    planner, td = ik_planner(), observe(home(2), MIDDLE)
    td["plan"] = TensorDict({"window": torch.arange(2)}, [2])
    planner(td)
    plan, copy = td["plan"], td["plan"].clone()
    later = td.copy().set("plan", plan).set("step_count", torch.ones(2, dtype=torch.int64))
    planner(later)
    assert td["plan"] is plan
    for key in copy.keys():  # noqa: SIM118
        assert torch.equal(plan[key], copy[key]), key
    assert sorted(plan.keys()) == ["path_goal", "path_pos", "path_step", "window"]
    assert later["plan", "path_step"].tolist() == [2, 2]
    assert torch.equal(later["plan", "window"], torch.arange(2))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)])
def test_batch_dimensions_are_free_and_equal_a_loop(batch, dtype):
    planner = IKPlanner(Arm.ur5(tool_length=SCENE.tool_length, dtype=dtype), approach=APPROACH)
    joint_pos = home(*batch, dtype=dtype, spread=0.1)
    goal = goals(max(math.prod(batch), 1)).to(dtype)[: math.prod(batch)].reshape(*batch, 3)
    path, td = after(observe(joint_pos, goal), planner, 12)
    assert td["plan", "path_pos"].shape == (*batch, 6)
    assert path.dtype == dtype
    rows = zip(joint_pos.reshape(-1, 6), goal.reshape(-1, 3), path.reshape(12, -1, 6).unbind(1), strict=True)
    for one_pos, one_goal, expected in rows:
        one, _ = after(observe(one_pos, one_goal), planner, 12)
        torch.testing.assert_close(one, expected, atol=1e-4 if dtype == torch.float32 else 1e-10, rtol=0)


def test_a_planner_serves_another_precision_than_its_own():
    td = observe(home(4, dtype=torch.float64, spread=0.1), goals(4).double())
    single, double = ik_planner()(td.clone())["action"], DOUBLE(td.clone())["action"]
    assert single.dtype == double.dtype == torch.float64
    torch.testing.assert_close(single, double, atol=1e-3, rtol=0)


def test_a_chunk_makes_results_independent_of_the_batch_size():
    planner, joint_pos, goal = ik_planner(chunk=32), home(21, spread=0.1), goals(21)
    whole, _ = after(observe(joint_pos, goal), planner, 12)
    for rows in (slice(0, 1), slice(3, 5), slice(4, 17)):
        part, _ = after(observe(joint_pos[rows], goal[rows]), planner, 12)
        assert torch.equal(part, whole[:, rows])


@pytest.mark.parametrize("key", ["joint_pos", "goal", "step_count"])
def test_a_missing_key_is_named(key):
    with pytest.raises(InputError, match=f"IKPlanner reads the key '{key}', which the tensordict lacks"):
        ik_planner()(observe(home(2), MIDDLE).exclude(key))


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"joint_pos": torch.zeros(2, 5)}, r"joint_pos must have shape \(\*B, 6\), got \(2, 5\)"),
        ({"goal": torch.zeros(2, 2)}, r"goal must have shape \(\*B, 2, 3\), got \(2, 2\)"),
        ({"goal": torch.full((2, 3), math.nan)}, "goal must be finite, got 6 NaN"),
        ({"goal": torch.tensor([[0.0, 0.0, 0.0], [0.0, -math.inf, 0.0]])}, "goal must be finite, got 1 NaN"),
    ],
)
def test_bad_input_is_refused_by_name(entry, message):
    with pytest.raises(InputError, match=message):
        ik_planner()(observe(home(2), MIDDLE).update(entry))


@pytest.mark.parametrize("chunk", [0, -1, 2.5])
def test_a_bad_chunk_is_refused(chunk):
    with pytest.raises(InputError, match="chunk must be"):
        ik_planner(chunk=chunk)


def test_memory_survives_resets_at_different_moments():
    env, planner, rows = TrapperEnv(3, seed=0, num_threads=1, velocity=0.5), TargetPursuit(ik_planner(chunk=4)), []
    td = env.reset()
    for step in range(40):
        if step in (7, 20, 21):
            td = env.reset(td.set("_reset", torch.tensor([[step == 7], [step != 7], [False]])), select_reset_only=True)
        data, td = env.step_and_maybe_reset(planner(td))
        rows.append(data.clone())
    data = torch.stack(rows, dim=-1)
    assert data["episode"].unique().tolist() == [0, 1, 2, 3, 4, 5]
    for row in data.unbind(0):
        for episode in row["episode"].unique().tolist():
            part = row[row["episode"] == episode]
            alone = TrapperEnv(1, seed=0, num_threads=1, velocity=0.5)
            alone.start_from(episode)
            expected = alone.rollout(len(part), planner)[0]
            for key in ("action", "goal", ("plan", "path_pos"), ("plan", "path_step"), ("next", "joint_pos")):
                assert torch.equal(part[key], expected[key]), key


def test_for_noisy_goals_it_has_another_damping():
    planner = ik_planner(noisy_damping=0.3, gain=0.2).eval()
    assert planner.for_noise(1e-4) is planner
    steady = planner.for_noise(0.002)
    assert steady.part_settings() == {
        name: value for name, value in planner.part_settings().items() if name != "noisy_damping"
    } | {"damping": 0.3}
    assert steady.for_noise(0.002) is steady
    assert not steady.training
    without = ik_planner(noisy_damping=None)
    assert without.for_noise(0.002) is without
    with pytest.raises(InputError, match="noisy_damping must be"):
        ik_planner(noisy_damping=-0.1)
