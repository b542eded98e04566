"""How long do plans of a planner of your own take? Your static planner and your search, timed beside ours.

The same from the command line, where rows are printed and saved as they come:
    torchdyn-plan bench replan --planner corner --planner examples.bench_own_planner:make_planner --out runs/bench.json
"""

import torch
from torch import Tensor

from torchdyn_plan.bench.replan import bench
from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.nets import ArrivalQuery, Forecast
from torchdyn_plan.planners import CallablePlanner, DynamicPlanner, Meeting, SearchContext

ARM = Arm.ur5(tool_length=TrapperScene().tool_length)
EVERY = torch.arange(5, 301, 5)  # control steps to the meetings that are looked at


def reach(joint_pos: Tensor, tool_pos: Tensor, goal: Tensor) -> Tensor:
    """Static planner: the transposed Jacobian turns the way to the goal into joint speeds."""
    _, jacobian = ARM.pose_and_jacobian(joint_pos)
    return (jacobian[..., :3, :].mT @ (goal - tool_pos).unsqueeze(-1)).squeeze(-1).clamp(-1.0, 1.0)


def first_in_time(forecast: Forecast, target_pos: Tensor, eta: ArrivalQuery, context: SearchContext) -> Meeting:
    """Search: the first place on the forecast at which the arm is there before the ball."""
    goals = forecast.path[..., EVERY - 1, :]
    in_time = eta(goals, estimator="expectation").steps <= EVERY
    first = in_time.int().argmax(dim=-1, keepdim=True)
    goal = goals.gather(-2, first.unsqueeze(-1).expand(*first.shape, 3)).squeeze(-2)
    return Meeting(goal, EVERY[first].squeeze(-1), torch.zeros_like(in_time[..., 0]), in_time.any(dim=-1))


def make_planner() -> DynamicPlanner:
    """The paper's planner for Trapper with both put in; networks stay those that ship."""
    static = CallablePlanner(reach, in_keys=("joint_pos", "tool_pos", "goal"))
    return DynamicPlanner.from_pretrained("trapper-ik", static=static, search=first_in_time)


def main() -> None:
    """Time both, and print what a plan and a step cost."""
    planners = {"ours": DynamicPlanner.from_pretrained("trapper-ik"), "mine": make_planner()}
    for row in bench(planners, batches=(1, 256), seconds=0.05, progress=False):
        if row["what"].startswith(("re-plan", "search", "step")):
            what = f"{row['what']}, {row['implementation'].partition(', ')[2] or 'as trained'}"
            print(f"{what:40} batch {row['batch']:3}: {row['median_us']:7.0f} µs, {row['per_second']:6} a second")


if __name__ == "__main__":
    main()
