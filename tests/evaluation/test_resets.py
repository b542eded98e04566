import torch
from torchrl.collectors import Collector

from tests.evaluation.untrained import untrained
from torchdyn_plan.envs import TrapperEnv
from torchdyn_plan.planners import ReplanSchedule

SOON = ReplanSchedule(first_step=3, window=7, minimum=5)


def alone(episode, length, max_steps):
    env = TrapperEnv(1, max_steps=max_steps, seed=0, num_threads=1)
    env.start_from(episode)
    return env.rollout(length, untrained(schedule=SOON), break_when_any_done=False)[0]


def assert_as_if_alone(data, at_least, max_steps=15):
    """Every whole episode in ``data`` (N, T) is what the planner does when it is alone, its memory included."""
    whole = 0
    names = ["action", "goal", "arrival_steps", "target_pos", "joint_pos"]
    for row in data.unbind(0):
        for episode in row["episode"].unique().tolist():
            part = row[row["episode"] == episode]
            if not bool(part["next", "done"][-1]):
                continue
            whole += 1
            single = alone(episode, len(part), max_steps)
            for name in (*names, *(("plan", name) for name in sorted(single["plan"].keys()))):
                assert torch.equal(part[name], single[name]), (episode, name)
    assert whole >= at_least


def test_the_planners_memory_survives_auto_reset():
    env, planner, rows = TrapperEnv(3, max_steps=15, seed=0, num_threads=1), untrained(schedule=SOON), []
    td = env.reset()
    for _ in range(46):
        data, td = env.step_and_maybe_reset(planner(td))
        rows.append(data.clone())
    assert_as_if_alone(torch.stack(rows, dim=1), 9)


def test_the_planners_memory_survives_a_reset_of_some_rows():
    env, planner, rows = TrapperEnv(3, max_steps=15, seed=0, num_threads=1), untrained(schedule=SOON), []
    td = env.reset()
    for step in range(35):
        stepped = env.step(planner(td))
        rows.append(stepped.clone())
        td = env.step_mdp(stepped)
        early = torch.tensor([[False], [step == 6], [False]])
        mask = td["done"] | early
        if mask.any():
            td = env.reset(td.set("_reset", mask)).exclude("_reset")
    assert_as_if_alone(torch.stack(rows, dim=1), 5)


def test_the_planners_memory_survives_a_collector():
    planner = untrained(schedule=SOON)
    frames = {"frames_per_batch": 60, "total_frames": 120, "auto_register_policy_transforms": False}
    collector = Collector(lambda: TrapperEnv(3, max_steps=15, seed=0, num_threads=1), planner, **frames)
    data = torch.cat([batch.clone() for batch in collector], dim=-1)
    collector.shutdown()
    assert_as_if_alone(data, 6)
