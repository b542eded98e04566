"""A planner of somebody's own in Trapper: static planner, forecast, arrival times and search are functions."""

import torch
from tensordict import TensorDict

from torchdyn_plan import keys
from torchdyn_plan.planners import CallablePlanner, DynamicPlanner, Meeting


def stand_still(robot_state, goal):
    return goal.new_zeros(*goal.shape[:-1], 6)


def straight_on(target_history):
    now = target_history[..., -1:, :]
    return now + (now - target_history[..., -2:-1, :]) * torch.arange(1.0, 301.0).unsqueeze(-1)


def always_forty(robot_state, goal):
    return goal.new_full(goal.shape[:-1], 40.0)


def meet_in_hundred(forecast, target_pos, eta, context=None):
    no = torch.zeros(target_pos.shape[:-1], dtype=torch.bool)
    return Meeting(forecast.path[..., 99, :], torch.full(no.shape, 100), no, ~no)


def make_planner(**parts):
    parts.setdefault("search", meet_in_hundred)
    return DynamicPlanner.paper(CallablePlanner(stand_still), straight_on, always_forty, **parts)


def stand_on_tensordict(tensordict):
    """A planner, for static goals or moving targets, that is a function of a tensordict."""
    return tensordict.set(keys.ACTION, torch.zeros(*tensordict.batch_size, 6))


PLANNER = make_planner()
NO_PLANNER = TensorDict()
