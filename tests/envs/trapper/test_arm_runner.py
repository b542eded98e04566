import pytest
import torch
from tensordict import TensorDict

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.envs.trapper.arm_runner import TrapperArmRunner
from torchdyn_plan.envs.trapper.contact import is_reached
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.tasks.trapper.task import ik_planner

SCENE = TrapperScene()
GOALS = torch.tensor([[0.1, -0.2, 0.042], [-0.3, -0.4, 0.042], [0.2, -0.3, 0.25], [0.7, 0.7, 0.042]])


class Recorder:
    """Static planner that keeps what it is shown and goes nowhere; it counts its steps in its memory."""

    def __init__(self):
        self.seen = []

    def __call__(self, td):
        self.seen.append(td.clone())
        counted = td["plan", "counted"] + 1 if "plan" in td.keys() else torch.ones(td.batch_size)  # noqa: SIM118
        td["plan"] = TensorDict({"counted": counted}, td.batch_size)
        return td.set("action", torch.zeros(*td.batch_size, 6))


def make_runner(planner=None, num_envs=4):
    return TrapperArmRunner(planner or ik_planner(SCENE, chunk=8), num_envs, num_threads=1)


def drive(runner, goals, steps=150):
    """Joint angles (T, N, 6) on the way to ``goals``, and whether they were reached, (T, N)."""
    path, reached = [], []
    for _ in range(steps):
        runner.step(goals)
        path.append(runner.simulation.joint_pos.clone())
        reached.append(runner.is_reached(goals))
    return torch.stack(path), torch.stack(reached)


def test_a_batch_of_goals_is_a_loop_over_them_and_a_reset_starts_over():
    runner = make_runner()
    together, reached = drive(runner, GOALS)
    assert reached[-1].tolist() == [True, True, True, False]
    assert not reached[0].any()
    runner.reset()
    again, _ = drive(runner, GOALS)
    assert torch.equal(again, together)
    for row in (0, 2):
        alone, _ = drive(make_runner(num_envs=1), GOALS[row : row + 1])
        assert torch.equal(alone[:, 0], together[:, row])


def test_a_reset_puts_arms_home_at_rest_and_the_ball_out_of_the_way():
    runner = make_runner()
    drive(runner, GOALS, steps=20)
    runner.reset()
    home = torch.tensor(SCENE.home, dtype=torch.float64)
    assert torch.equal(runner.simulation.joint_pos, home.expand(4, 6))
    assert not runner.simulation.joint_vel.any()
    assert torch.equal(runner.robot_state[:, :6], home.float().expand(4, 6))
    assert (runner.simulation.ball_pos[:, :2] - torch.tensor(SCENE.base_pos[:2])).norm(dim=-1).min() > 1.2


def test_arms_are_put_where_they_are_told():
    runner, joint_pos = make_runner(), torch.tensor(SCENE.home) + 0.1 * torch.arange(4).unsqueeze(-1)
    runner.reset(joint_pos)
    assert torch.equal(runner.simulation.joint_pos.float(), joint_pos)
    assert not runner.simulation.joint_vel.any()
    expected = Arm.ur5(tool_length=SCENE.tool_length)(joint_pos)[:, :3, 3] + torch.tensor(SCENE.base_pos)
    torch.testing.assert_close(runner.tool_pos, expected, atol=1e-6, rtol=0)
    assert torch.equal(runner.robot_state[:, 12:], runner.tool_pos)
    runner.reset(joint_pos, torch.full((4, 6), 0.5))
    assert (runner.robot_state[:, 6:12] == 0.5).all()
    with pytest.raises(InputError, match="joint_vel needs joint_pos"):
        runner.reset(joint_vel=torch.zeros(4, 6))


def test_the_planner_sees_each_arms_goal_and_its_own_memory_until_the_reset():
    planner = Recorder()
    runner = make_runner(planner)
    for step in range(3):
        runner.step(GOALS)
        seen = planner.seen[-1]
        assert torch.equal(seen["goal"], GOALS)
        assert seen["step_count"].tolist() == [step] * 4
        assert ("plan" in seen.keys()) is (step > 0)  # noqa: SIM118
        state = torch.cat([seen[name] for name in ("joint_pos", "joint_vel", "tool_pos")], dim=-1)
        assert torch.equal(seen["robot_state"], state)
        assert torch.equal(seen["observation"], state)
    assert planner.seen[-1]["plan", "counted"].tolist() == [2] * 4
    runner.reset()
    runner.step(GOALS)
    assert "plan" not in planner.seen[-1].keys()  # noqa: SIM118
    assert planner.seen[-1]["step_count"].tolist() == [0] * 4


def test_is_reached_asks_for_the_tool_of_each_arm():
    runner = make_runner(Recorder())
    tool = runner.tool_pos
    off = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.014, 0.0], [0.016, 0.0, 0.0], [0.0, 0.0, -tool[3, 2] + 0.042]])
    assert runner.is_reached(tool + off).tolist() == [True, True, False, False]
    assert torch.equal(runner.is_reached(tool + off), is_reached(SCENE, tool, tool + off))
