"""A control loop at 250 Hz that waits for nobody: a 30 Hz camera and the planner have a thread each.

The camera errs by 5 mm and says when it looked; a track makes of that where the ball is now. How long a plan takes is
measured and told to the planner, which plans for when the plan is there; one that comes too late is dropped. With
``--simulated`` the world waits for the camera, and plans take 8 ms: the same balls are trapped on every machine.
"""

import sys
import time
from threading import Condition, Thread

import torch

from torchdyn_plan import DynamicPlanner
from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.planners import Background, Delayed, KalmanTrack, Plan, TrackedPlanner, measured_latency, observe

STEP, RATE, NOISE = 0.004, 30.0, 0.005  # control step [s], pictures a second, standard deviation of their error [m]
BALLS, SIMULATED = 4, "--simulated" in sys.argv


class Camera:
    """Looks at a ball in a thread of its own, in the time of the world that the ball is in."""

    def __init__(self) -> None:
        self.moved, self.time, self.place = Condition(), -1.0, torch.zeros(3)
        self.taken, self.count, self.draw = torch.empty(0, 4), 0, torch.Generator().manual_seed(0)
        Thread(target=self._run, daemon=True).start()

    def _is_due(self) -> bool:
        return self.time >= self.count / RATE

    def _run(self) -> None:
        while True:
            with self.moved:
                self.moved.wait_for(self._is_due)
                seen = self.place + NOISE * torch.randn(3, generator=self.draw)
                self.taken = torch.cat([self.taken, torch.tensor([[self.time, *seen]])])
                self.count += 1
                self.moved.notify_all()

    def look(self, now: float, place: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Move the world on; what has come since the last step: moments (1, M) [s] and places (1, M, 3) [m]."""
        with self.moved:
            if now == 0.0:  # another ball
                self.count, self.taken = 0, self.taken[:0]
            self.time, self.place = now, place
            self.moved.notify_all()
            self.moved.wait_for(lambda: not (SIMULATED and self._is_due()))
            taken, self.taken = self.taken, self.taken[:0]
        return taken[None, :, 0], taken[None, :, 1:]


torch.set_num_threads(1)
torch.set_grad_enabled(False)
env, camera = TrapperEnv(velocity=2.0, seed=0, split="dev", num_threads=1), Camera()
inner = DynamicPlanner.from_pretrained("trapper-ik-wait_and_drop")
state = env.reset()
seen = observe(state, inner.forecaster)
latency = 2 if SIMULATED else measured_latency(lambda: inner.replan(seen, Plan.hold(seen, length=0)), STEP)
background = Background(latency=latency, deadline=latency + 4)
inner = inner.with_parts(delivery=Delayed(latency) if SIMULATED else background)
planner = TrackedPlanner(inner, KalmanTrack(noise=NOISE), control_step=STEP)

balls, trapped, steps, overruns, next_tick = 0, 0, 0, 0, time.perf_counter()
while balls < BALLS:
    now = STEP * int(state["step_count"])
    state["measured_time"], state["measured_pos"] = camera.look(now, env.target_pos[0])
    stepped, state = env.step_and_maybe_reset(planner(state))  # the world takes one step of 4 ms
    balls, trapped = balls + int(stepped["next", "done"]), trapped + int(stepped["next", "trapped"])
    steps, next_tick = steps + 1, next_tick + STEP
    if time.perf_counter() > next_tick:
        overruns, next_tick = overruns + 1, time.perf_counter()
    elif not SIMULATED:
        time.sleep(max(0.0, next_tick - time.perf_counter()))
background.close()
print(f"a plan takes up to {1000 * STEP * latency:.0f} ms, which the planner was told")
if not SIMULATED:
    print(f"{background.used} plans came into use, {background.missed} missed their deadline")
print(f"{trapped} of {BALLS} balls trapped; {overruns} of {steps} steps took longer than 4 ms")
