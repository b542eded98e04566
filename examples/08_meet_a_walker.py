"""A base on wheels meets walkers, with nothing trained, as a moving picture; beside it one that runs after them.

python examples/08_meet_a_walker.py meeting.webp
"""

import sys

import numpy as np
import torch
from PIL import Image

from torchdyn_plan.envs.chase import ChaseEnv, ChaseWorld
from torchdyn_plan.envs.chase.picture import draw_world
from torchdyn_plan.planners import DynamicPlanner, PointPlanner, TargetPursuit

WALKERS, EVERY, SIZE = 3, 8, 260  # how many, control steps from picture to picture, and their side [pixels]
REST = 10  # pictures for which the last one stays
world = ChaseWorld()
limits = {"speed": world.base_speed, "acceleration": world.base_acceleration, "control_step": world.control_step}
drive = PointPlanner(**limits, stops=False, radius=world.radius)


def play(planner: torch.nn.Module) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, list[int]]:
    """Places of bases and walkers and goals, ``(N, T, 2)`` each, and at which of the T they have met."""
    env = ChaseEnv(WALKERS, speed=1.1, seed=16, split="dev")
    seen = env.rollout(env.max_steps, planner, break_when_any_done=False)
    met = seen["next", "met"].squeeze(-1)
    steps = torch.where(met.any(1), met.int().argmax(1), env.max_steps - 1)
    return seen["next", "tool_pos"], seen["next", "target_pos"], seen["goal"], steps.tolist()


def draw(played: tuple, row: int, step: int) -> np.ndarray:
    """A picture at ``step``, or of when they met if that was before."""
    base, walker, goal, met = played
    now = min(step, met[row])
    trails = base[row, : now + 1], walker[row, : now + 1]
    return draw_world(world, trails[0][-1], trails[1][-1], SIZE, SIZE, goal=goal[row, now], trails=trails)


meeting, running = play(DynamicPlanner(drive)), play(TargetPursuit(drive))
for row in range(WALKERS):
    print(f"walker {row}: met after {meeting[3][row] + 1} steps, run after for {running[3][row] + 1}")
last = max(meeting[3] + running[3])
frames = []
for step in [*range(0, last, EVERY), *[last] * REST]:
    rows = [np.hstack([draw(played, row, step) for row in range(WALKERS)]) for played in (meeting, running)]
    frames.append(Image.fromarray(np.vstack(rows)))
if len(sys.argv) > 1:
    pause = int(1000 * EVERY * world.control_step)
    frames[0].save(sys.argv[1], save_all=True, append_images=frames[1:], duration=pause, loop=0)
    print(f"written: {sys.argv[1]}, {len(frames)} pictures")
