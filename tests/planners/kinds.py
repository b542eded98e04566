"""Planners of every kind, on what they see in the tasks' own environments: for tests of what all have in common."""

import functools

import torch

from torchdyn_plan.kinematics import Arm
from torchdyn_plan.planners import (
    CallablePlanner,
    CornerSearch,
    Delayed,
    EventSchedule,
    ExactSearch,
    IKPlanner,
    PolicyPlanner,
    ProportionalController,
    RecordedFuture,
    SoftCornerSearch,
    SoftExactSearch,
)
from torchdyn_plan.tasks import load_task

ROWS = 6


@functools.cache
def seen_in(task):
    """`ROWS` rows of what planners see some steps into episodes of ``task``, none planned in; the same each time."""
    env = load_task(task).make_env(
        load_task(task).default_settings(), num_envs=ROWS, seed=0, split="dev", num_threads=1
    )
    torch.manual_seed(0)
    td = env.reset()
    for _ in range(13):
        td = env.step_and_maybe_reset(env.rand_action(td))[1]
    ahead = torch.arange(0.0, 200.0).view(-1, 1)
    recording = td["target_pos"].unsqueeze(-2) + 1e-3 * ahead * torch.tensor([1.0, -1.0, 0.0])
    return td.exclude("plan").set("goal", td["target_pos"] + 0.05).set("target_future", recording)


def observe(task, batch=None):
    """`seen_in`, its own copy, in the batch ``batch`` where that is given."""
    seen = seen_in(task).clone()
    return seen if batch is None else seen.reshape(*batch)


def trapper(name, static="ik", **parts):
    def make():
        planner = load_task("trapper").planner(name, static)
        return planner.with_parts(**parts) if parts else planner

    return make


def reach(name, static="proportional"):
    return lambda: load_task("fetch_reach").planner(name, static)


def straight(robot_state, goal):
    return torch.nn.functional.pad((goal - robot_state[..., 12:15]).clamp(-1, 1), (0, 3))


DYNAMIC = {
    "corner": trapper("corner"),
    "corner with a policy": trapper("corner", "rl"),
    "exact": trapper("exact"),
    "wait and drop": trapper("wait_and_drop"),
    "wait and drop with a policy": trapper("wait_and_drop", "rl"),
    "wait at the end": trapper("wait"),
    "oracle": trapper("corner", forecaster=RecordedFuture(100)),
    "soft corner": trapper("corner", search=SoftCornerSearch()),
    "soft exact": trapper("corner", search=SoftExactSearch(search=ExactSearch(footprint=0.05))),
    "coarse": trapper("exact", search=ExactSearch(coarse=4)),
    "expectation": trapper("corner", search=CornerSearch(estimator="expectation")),
    "delayed": trapper("wait_and_drop", delivery=Delayed(2)),
    "on events": trapper("wait_and_drop", schedule=EventSchedule(minimum=5, first_step=13)),
    "with an own static planner": lambda: trapper("corner")().with_parts(static=CallablePlanner(straight)),
}
FOR_INFERENCE = {
    f"{name} for inference": lambda make=DYNAMIC[name]: make().for_inference()
    for name in ("corner", "wait and drop", "soft exact")
}
STATIC = {
    "pursuit": trapper("pursuit"),
    "pursuit with a policy": trapper("pursuit", "rl"),
    "ik": lambda: load_task("trapper").static_planner("ik"),
    "ik straight": lambda: IKPlanner(Arm.ur5(tool_length=0.1)),
    "ik in blocks": lambda: load_task("trapper").static_planner("ik", chunk=4),
    "policy": lambda: load_task("trapper").static_planner("rl"),
    "policy that holds": lambda: PolicyPlanner.from_pretrained("trapper", period=4),
    "function": lambda: CallablePlanner(straight),
}
TRAPPER = DYNAMIC | FOR_INFERENCE | STATIC
REACH = {
    "reach corner": reach("corner"),
    "reach exact": reach("exact"),
    "reach corner with a policy": reach("corner", "rl"),
    "reach pursuit": reach("pursuit"),
    "proportional": lambda: ProportionalController(gain=10.0, action_size=4),
}
PLANNERS = {name: ("trapper", make) for name, make in TRAPPER.items()} | {
    name: ("fetch_reach", make) for name, make in REACH.items()
}
