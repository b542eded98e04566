"""A UR10 meets thrown balls in the air with a cup, as a camera of 60 Hz sees them; nothing is trained.

python examples/10_meet_a_thrown_ball.py balls.webp
"""

import sys

import torch
from PIL import Image

from torchdyn_plan.envs import Sensor
from torchdyn_plan.envs.catch import CatchEnv
from torchdyn_plan.planners import BallisticTrack, TrackedPlanner
from torchdyn_plan.tasks import load_task

BALLS, EVERY, SLOWER, SIZE = 4, 3, 2.0, (400, 300)  # throws, steps from picture to picture, slow motion, pixels
drawn = len(sys.argv) > 1
camera = Sensor(noise=0.003, rate=60.0)  # 3 mm, 60 times a second
mode = "rgb_array" if drawn else None
env = CatchEnv(1, seed=0, split="dev", sensor=camera, num_threads=1, render_mode=mode)
planner = TrackedPlanner(load_task("catch").planner("meet"), BallisticTrack(noise=0.003), control_step=env.control_step)
state, frames = env.reset(), []
with torch.no_grad():
    for ball in range(BALLS):
        for step in range(env.max_steps):
            state = planner(state)
            seen = env.step(state)["next"]
            if drawn and step % EVERY == 0:
                frames.append(Image.fromarray(env.render(row=0, width=SIZE[0], height=SIZE[1])))
            if seen["done"].all():
                break
            state = seen.set("plan", state["plan"])
        seconds = env.control_step * int(seen["step_count"])
        print(f"ball {ball}: {'in the cup' if seen['caught'].all() else 'missed'} after {seconds:.2f} s")
        state = env.reset()
if drawn:
    pause = int(1000 * EVERY * SLOWER * env.control_step)
    frames[0].save(sys.argv[1], save_all=True, append_images=frames[1:], duration=pause, loop=0, quality=70)
    print(f"written: {sys.argv[1]}, {len(frames)} pictures")
