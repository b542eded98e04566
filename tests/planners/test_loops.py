"""A planner plans the same in every loop that TorchRL and PyTorch have."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import EnvCreator, ParallelEnv, RewardSum, SerialEnv, TransformedEnv

from tests.planners.first_plan import first_plan
from tests.planners.test_compiled import asked
from tests.planners.toy import SCHEDULE, SPEED, Straight, ToyEnv, assert_same, go_straight
from torchdyn_plan.planners import Delayed, DynamicPlanner, Plan, ReplanSchedule
from torchdyn_plan.tasks import load_task

STEPS, FIRST = 60, (0, 50)
PARTS = {
    "paper's clock": {},
    "every third step": {"schedule": ReplanSchedule.every(3, first_step=1)},
    "late": {"delivery": Delayed(3)},
}

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def make_planner(**parts):
    """A planner of functions, which note nothing: a compiler would compile anew after every note."""

    def arrival(robot_state, goal):
        return (goal - robot_state[..., -3:]).norm(dim=-1) / SPEED

    return DynamicPlanner.paper(go_straight(), Straight().path, arrival, **{"schedule": SCHEDULE, **parts})


def primed(env, planner):
    return TransformedEnv(env, planner.make_tensordict_primer())


def rolled(env, planner):
    try:
        return env.rollout(STEPS, planner, break_when_any_done=False)
    finally:
        env.close()


def collected(env, planner):
    collector = Collector(
        env, planner, frames_per_batch=4 * STEPS, total_frames=4 * STEPS, auto_register_policy_transforms=False
    )
    try:
        return next(iter(collector)).clone()
    finally:
        collector.shutdown()


def workers(kind, planner, *, make=partial, **settings):
    """Two processes, or none, with two episodes each."""
    return primed(kind(2, [make(ToyEnv, 2, first_episode=first) for first in FIRST], **settings), planner)


def created(kind, *args, **settings):
    return EnvCreator(partial(kind, *args, **settings))


def by_hand(planner, *, halfway=lambda td: td):
    """Step by step in the first worker's world and then in the second's; ``halfway`` may do with the state as it is."""
    rows = []
    for first in FIRST:
        env, steps = ToyEnv(2, first_episode=first), []
        td = env.reset()
        for step in range(STEPS):
            if step == STEPS // 2:
                td = halfway(td)
            stepped, td = env.step_and_maybe_reset(planner(td))
            steps.append(stepped)
        rows.append(torch.stack(steps, dim=-1))
    return torch.stack(rows)


def through_a_file(folder, td):
    """As if the loop was cut off, and another process went on from what it had saved."""
    torch.save(td.to_dict(), folder / "state.pt")
    return TensorDict(torch.load(folder / "state.pt"), batch_size=td.batch_size)


def compiled(planner):
    torch._dynamo.reset()
    return torch.compile(planner, backend="eager", fullgraph=True)


FORK = {"mp_start_method": "fork"}
LOOPS = {
    "SerialEnv": lambda planner, _: rolled(workers(SerialEnv, planner), planner),
    "ParallelEnv": lambda planner, _: rolled(workers(ParallelEnv, planner, **FORK), planner),
    "Collector of SerialEnv": lambda planner, _: collected(workers(SerialEnv, planner), planner),
    "Collector of ParallelEnv": lambda planner, _: collected(workers(ParallelEnv, planner, **FORK), planner),
    "EnvCreator": lambda planner, _: rolled(workers(ParallelEnv, planner, make=created, **FORK), planner),
    "TransformedEnv": lambda planner, _: rolled(TransformedEnv(workers(SerialEnv, planner), RewardSum()), planner),
    "compiled": lambda planner, _: rolled(workers(SerialEnv, planner), compiled(planner)),
    "cut off": lambda planner, folder: by_hand(planner, halfway=partial(through_a_file, folder)),
}


# How processes and collectors carry a memory has to do with no part of a planner: one that remembers most is enough.
CASES = [(loop, parts) for loop in LOOPS for parts in PARTS if loop in {"SerialEnv", "compiled"} or parts == "late"]


@pytest.mark.parametrize(("loop", "parts"), CASES)
def test_plans_and_actions_are_those_of_the_plain_loop(loop, parts, tmp_path):
    expected = by_hand(make_planner(**PARTS[parts]))
    found = LOOPS[loop](make_planner(**PARTS[parts]), tmp_path)
    assert_same(found, expected)
    assert bool((expected["plan", "replans"].amax(-1) >= 2).all())


@pytest.mark.parametrize("name", ["corner", "wait_and_drop"])
def test_planning_can_be_exported(name):
    planner = load_task("trapper").planner(name, "ik").requires_grad_(False)
    observation, plan = asked(planner, first_plan(3))

    class Replan(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.planner = planner

        def forward(self, observation, plan):
            return self.planner.replan(observation, plan)

    exported = torch.export.export(Replan(), (observation, plan), strict=True)
    for field, one, other in zip(
        Plan._fields, exported.module()(observation, plan), planner.replan(observation, plan), strict=True
    ):
        torch.testing.assert_close(one, other, msg=field)
