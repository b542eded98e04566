"""Fine-tune the forecaster by rolling the planner out: its meetings against where the balls then truly are.

`env.rollout` takes a planner that learns as it takes any policy. The soft search passes gradients from the meeting back
to the forecast; the environment detaches the actions, so that nothing of the graph stays in it.

python examples/fine_tune_in_rollout.py --rounds 30 --balls 128
"""

import argparse

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.nets import Forecaster
from torchdyn_plan.planners import DynamicPlanner, ReplanSchedule, SoftExactSearch
from torchdyn_plan.planners.search.soft import between
from torchdyn_plan.tasks import load_task

parser = argparse.ArgumentParser(description=__doc__)
for name, default in (("rounds", 3), ("balls", 16), ("steps", 200), ("seed", 0), ("lr", 1e-5), ("velocity", 3.0)):
    parser.add_argument(f"--{name}", type=type(default), default=default)
arguments = parser.parse_args()
torch.set_num_threads(1)

forecaster = Forecaster.from_pretrained("trapper")
planner: DynamicPlanner = load_task("trapper").planner("corner", "ik")
planner = planner.requires_grad_(False).with_parts(
    forecaster=forecaster.requires_grad_(True),
    search=SoftExactSearch(temperature=2.0),
    schedule=ReplanSchedule.every(20, first_step=13),
)


def misses(rollout: TensorDictBase) -> Tensor:
    """How far each ball is from a planned meeting at its time [m], of the plans ``(P,)`` whose time was played."""
    row, step = rollout["plan", "replanned"].nonzero(as_tuple=True)
    ahead, goal = rollout["arrival_steps"][row, step], rollout["goal"][row, step]
    then = (step + ahead.detach().ceil().long()).clamp(max=rollout.shape[1] - 1)
    # A ball that rolls into a pocket, or whose time comes after the end, tells nothing of the meeting.
    played = (step + ahead < rollout.shape[1] - 1) & (rollout["episode"][row, then] == rollout["episode"][row, step])
    paths = rollout["target_pos"][row[played]]
    there = between(paths, (step + ahead)[played].unsqueeze(-1)).squeeze(-2)
    return (there - goal[played])[:, :2].norm(dim=-1)


optimiser = torch.optim.Adam(forecaster.parameters(), lr=arguments.lr)
env = TrapperEnv(arguments.balls, velocity=arguments.velocity, seed=arguments.seed, num_threads=1)
for number in range(arguments.rounds):
    miss = misses(env.rollout(arguments.steps, planner, break_when_any_done=False))
    loss = (miss / (miss + 0.05)).mean()  # to miss by a metre is no worse than by ten centimetres
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    print(f"round {number + 1}: {len(miss)} meetings, missed by {1000 * miss.median():.1f} mm (median)")
