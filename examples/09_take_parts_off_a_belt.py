"""A Panda takes three parts off a belt that does not stop, with nothing trained, as a moving picture.

python examples/09_take_parts_off_a_belt.py belt.webp
"""

import sys

import torch
from PIL import Image

from torchdyn_plan.envs.conveyor import ConveyorEnv
from torchdyn_plan.tasks import load_task

SPEED, PARTS, EVERY, SIZE = 0.35, 3, 5, (400, 300)  # belt [m/s], parts, control steps from picture to picture, pixels
drawn = len(sys.argv) > 1
env = ConveyorEnv(1, speed=SPEED, parts=PARTS, seed=0, split="dev", render_mode="rgb_array" if drawn else None)
planner = load_task("conveyor").planner("meet")
state, frames, taken = env.reset(), [], 0
with torch.no_grad():
    for step in range(env.max_steps):
        state = planner(state)
        seen = env.step(state)["next"]
        count = int(seen["parts_taken"].sum())
        if count > taken:
            taken = count
            print(f"part {taken} of {PARTS} is off the belt after {env.control_step * (step + 1):.1f} s")
        if drawn and step % EVERY == 0:
            frames.append(Image.fromarray(env.render(row=0, width=SIZE[0], height=SIZE[1])))
        if seen["done"].all():
            break
        state = seen.set("plan", state["plan"])
if drawn:
    pause = int(1000 * EVERY * env.control_step)
    frames[0].save(sys.argv[1], save_all=True, append_images=frames[1:], duration=pause, loop=0, quality=70)
    print(f"written: {sys.argv[1]}, {len(frames)} pictures")
