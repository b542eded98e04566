import torch

from torchdyn_plan.envs.goal_motion import HEIGHT
from torchdyn_plan.envs.reach import STATE_SIZE, DynamicReachEnv
from torchdyn_plan.training.arrivals import Arrivals
from torchdyn_plan.training.tasks import FIT_TASKS, reach_task, trapper_task


def arrivals(state, goal):
    steps = torch.tensor([29, 30, -1])
    return Arrivals(state, goal, steps, torch.arange(3))


def test_arrivals_of_trapper_are_grouped_by_height_and_joint_speed():
    state = torch.zeros(3, 15)
    state[1, 7], state[2, 0] = -1.0, 5.0
    goal = torch.tensor([[0.0, 0.0, 0.03], [0.0, 0.0, 0.2], [0.0, 0.0, 0.047]])
    groups = trapper_task().groups(arrivals(state, goal))
    assert groups["on table"].tolist() == [True, False, True]
    assert groups["above table"].tolist() == [False, True, False]
    assert groups["at rest"].tolist() == [True, False, True]


def test_arrivals_of_reach_are_grouped_by_height_and_gripper_speed():
    state = torch.zeros(3, STATE_SIZE)
    state[1, 6] = 0.01
    goal = torch.tensor([[1.3, 0.7, HEIGHT], [1.3, 0.7, 0.6], [1.3, 0.7, HEIGHT]])
    groups = reach_task().groups(arrivals(state, goal))
    assert groups["level"].tolist() == [True, False, True]
    assert groups["in motion"].tolist() == [False, True, False]


def test_a_task_is_called_what_the_command_line_calls_it():
    assert {name: make().name for name, make in FIT_TASKS.items()} == {name: name for name in FIT_TASKS}


def test_networks_of_reach_fit_its_environment():
    task, env = reach_task(), DynamicReachEnv(1, num_threads=1)
    td = env.reset()
    assert td["target_history"].shape[-2] == task.forecaster.history
    assert td["robot_state"].shape[-1] == task.eta.robot_state_size
    assert torch.equal(td["robot_state"][:, slice(*task.eta.tool_slice)], td["tool_pos"])
    assert task.eta.bins * task.eta.bin_width == env.max_steps
