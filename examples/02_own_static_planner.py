"""Bring your own static planner: any function of tensors becomes one that meets a moving target.

A point robot that flies straight to its goal at 1 m/s, and a target that passes by at 0.8 m/s.
"""

import torch
from tensordict import TensorDict
from torch import Tensor

from torchdyn_plan.planners import CallablePlanner, DynamicPlanner

STEP = 0.01  # what the robot covers in a control step [m]


def fly(robot_state: Tensor, goal: Tensor) -> Tensor:
    """Static planner: straight to the goal, an action is a step."""
    way = goal - robot_state
    return way / way.norm(dim=-1, keepdim=True).clamp_min(STEP)


def flight_time(robot_state: Tensor, goal: Tensor) -> Tensor:
    """Steps that `fly` needs: what an `ETANetwork` learns for a robot whose planner has no formula."""
    return (goal - robot_state).norm(dim=-1) / STEP


def straight_on(target_history: Tensor) -> Tensor:
    """Forecast: the last step, again and again."""
    now, step = target_history[..., -1:, :], target_history[..., -1:, :] - target_history[..., -2:-1, :]
    return now + step * torch.arange(1.0, 301.0).unsqueeze(-1)


planner = DynamicPlanner(CallablePlanner(fly), straight_on, flight_time)
robot, target = torch.zeros(1, 3), torch.tensor([[-1.5, 1.0, 0.0]])
velocity = torch.tensor([[0.008, 0.0, 0.0]])
history = target.unsqueeze(1).repeat(1, 24, 1)
state = TensorDict(batch_size=[1])
for step in range(400):
    state.update({"robot_state": robot, "tool_pos": robot, "target_pos": target, "target_history": history})
    state["step_count"] = torch.tensor([step])
    planner(state)
    robot, target = robot + STEP * state["action"], target + velocity
    history = torch.cat([history[:, 1:], target.unsqueeze(1)], dim=1)
    miss = (robot - target).norm().item()
    if step % 25 == 0 or miss < 0.05:
        print(f"step {step:3}: goal {state['goal'][0, :2].tolist()}, distance to the target {miss:.2f} m")
    if miss < 0.05:
        break
