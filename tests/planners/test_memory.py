import pytest
import torch
from torchrl.collectors import Collector

from tests.planners.toy import ToyEnv, assert_same, make_planner, observation
from torchdyn_plan.planners import PlanStatus


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
def test_memory_survives_a_collector(use_buffers):
    frames = {"frames_per_batch": 4 * 30, "total_frames": 4 * 300}
    settings = {"use_buffers": use_buffers, "auto_register_policy_transforms": False}
    collector = Collector(lambda: ToyEnv(4), make_planner(), **frames, **settings)
    data = torch.cat([batch.clone() for batch in collector], dim=-1)
    collector.shutdown()
    found = episodes(data)
    assert len(found) > 10
    for number, part in found.items():
        assert_same(part, alone(number))


def test_a_reset_clears_the_planners_memory_and_leaves_the_static_planners_alone():
    planner, td = make_planner(), observation((2,), step=3)
    td["target_pos"] = td["target_pos"] + 1e4
    planner(td)
    td["plan", "clamped"] = torch.ones(2, dtype=torch.bool)
    td["plan", "path"] = torch.arange(2)
    td["step_count"] = torch.tensor([0, 4])
    planner(td)
    memory = {key: value.tolist() for key, value in td["plan"].items()}
    assert memory.pop("goal") == [td["tool_pos"][0].tolist(), td["goal"][1].tolist()]
    assert memory == {
        "window": [12, 10], "countdown": [3, 9], "replans": [0, 1], "arrival_steps": [0, td["arrival_steps"][1]],
        "clamped": [False, True], "reachable": [True, False], "replanned": [False, False], "path": [0, 1],
        "status": [PlanStatus.WAITING, PlanStatus.UNREACHABLE], "usable": [True, True],
    }  # fmt: skip


def test_a_rollout_can_be_resumed_from_its_tensordict():
    env, planner = ToyEnv(2), make_planner()
    td = env.reset()
    for _ in range(25):
        td = env.step_mdp(env.step(planner(td)))
    copy = td.clone()
    assert_same(planner(td), make_planner()(copy))
    assert td["plan", "replans"].tolist() == [3, 3]
