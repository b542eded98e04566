import pytest
import torch

from tests.envs.fetch_reach.fetch_original import original_fetch_reach
from torchdyn_plan.envs import FetchSimulation
from torchdyn_plan.envs.fetch_reach import simulation as fetch_module
from torchdyn_plan.errors import InputError

EPISODES, STEPS = 100, 50


@pytest.fixture(scope="module")
def actions():
    return torch.rand(STEPS, EPISODES, 4, generator=torch.Generator().manual_seed(0)) * 2.2 - 1.1


def play(simulation, actions):
    """State before and after every step, (T + 1, N, 10) and (T + 1, N, nq)."""
    simulation.reset(torch.arange(simulation.num_envs))
    states, poses = [simulation.robot_state], [simulation.qpos.clone()]
    for action in actions:
        simulation.step(action)
        states.append(simulation.robot_state)
        poses.append(simulation.qpos.clone())
    return torch.stack(states), torch.stack(poses)


def test_every_step_agrees_with_the_original_to_a_micrometre(actions):
    states, poses = play(FetchSimulation(EPISODES), actions)
    original = original_fetch_reach()
    for row in range(EPISODES):
        observed, _ = original.reset(seed=row)
        for step in range(STEPS + 1):
            if step:
                observed, *_ = original.step(actions[step - 1, row].double().numpy())
            torch.testing.assert_close(states[step, row], torch.tensor(observed["observation"]), atol=1e-6, rtol=0)
            torch.testing.assert_close(poses[step, row], torch.tensor(original.data.qpos), atol=1e-6, rtol=0)


def test_the_start_is_where_the_original_draws_goals_around():
    start = FetchSimulation(1).start
    torch.testing.assert_close(start.tool_pos, torch.tensor(original_fetch_reach().initial_gripper_xpos))


@pytest.mark.parametrize(("num_envs", "threads"), [(1, 1), (5, 2)])
def test_arms_do_not_depend_on_their_neighbours_or_on_threads(actions, num_envs, threads):
    everything, _ = play(FetchSimulation(8), actions[:12, :8])
    some, _ = play(FetchSimulation(num_envs, num_threads=threads), actions[:12, :num_envs])
    assert torch.equal(some, everything[:, :num_envs])


def test_a_reset_puts_back_its_rows_alone(actions):
    simulation = FetchSimulation(3)
    start = simulation.robot_state
    for action in actions[:4, :3]:
        simulation.step(action)
    before = simulation.robot_state
    simulation.reset(torch.tensor([1]))
    after = simulation.robot_state
    assert torch.equal(after[1], start[1])
    assert torch.equal(after[[0, 2]], before[[0, 2]])


def test_fingers_stay_shut_and_a_fourth_entry_of_an_action_means_nothing(actions):
    with_fingers, _ = play(FetchSimulation(2), actions[:5, :2])
    without, poses = play(FetchSimulation(2), actions[:5, :2, :3])
    assert torch.equal(with_fingers, without)
    assert not poses[1:, :, -2:].any()


def test_a_missing_model_is_named(monkeypatch):
    monkeypatch.setattr(fetch_module.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"torchdyn-plan\[reach\]"):
        fetch_module.fetch_model_path()
