"""A control loop at 250 Hz that does not wait for its planner: plans are made in a thread beside it.

How long a plan takes is measured first and told to the planner, which then plans for the moment when the plan is
there. A plan that misses its deadline is dropped, and the arm goes on to the last goal.
"""

import time

import torch

from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.planners import Background, DynamicPlanner, Plan, measured_latency, observe

STEP = 0.004  # length of a control step [s]
STEPS = 500  # two seconds

torch.set_num_threads(1)
env = TrapperEnv(num_envs=1, velocity=2.0, seed=0, num_threads=1)
planner = DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop")


def run_loop() -> tuple[int, int, int]:
    """Balls met and trapped, and control steps that took too long."""
    state, next_tick, balls, trapped, overruns = env.reset(), time.perf_counter(), 0, 0, 0
    for _ in range(STEPS):
        stepped, state = env.step_and_maybe_reset(planner(state))  # the world takes one step of 4 ms
        balls += int(stepped["next", "done"])
        trapped += int(stepped["next", "trapped"])
        next_tick += STEP
        wait = next_tick - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        else:
            overruns, next_tick = overruns + 1, time.perf_counter()
    return balls, trapped, overruns


seen = observe(env.reset(), planner.forecaster)
with torch.no_grad():
    latency = measured_latency(lambda: planner.replan(seen, Plan.hold(seen, length=0)), STEP)
background = Background(latency=latency, deadline=latency + 4)
planner = planner.with_parts(delivery=background)
with torch.no_grad():
    balls, trapped, overruns = run_loop()
background.close()
print(f"a plan takes up to {latency} steps of 4 ms, which the planner was told")
print(f"{background.used} plans came into use, {background.missed} missed the deadline of {latency + 4} steps")
print(f"{trapped} of {balls} balls trapped; {overruns} of {STEPS} steps took longer than 4 ms")
