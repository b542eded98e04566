import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.envs.trapper.contact import is_covered
from torchdyn_plan.envs.trapper.env import HOLD_STEPS
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.planners import TargetPursuit
from torchdyn_plan.tasks.trapper.task import ik_planner

SCENE = TrapperScene()


def make_env(num_envs=2, **settings):
    return TrapperEnv(num_envs, **{"num_threads": 1, "seed": 0, **settings})


def same(one, other):
    return all(torch.equal(one[key], other[key]) for key in one.keys(include_nested=True, leaves_only=True))


def wave(td):
    """Actions that are a function of episode and step alone."""
    phase = 0.1 * td["step_count"].squeeze(-1) + td["episode"]
    td["action"] = torch.sin(phase.unsqueeze(-1) + torch.arange(6))
    return td


def play(env, actions):
    """Every step's "next" under fixed ``actions`` (T, N, 6), (T, N)."""
    td = env.reset()
    steps = []
    for action in actions:
        td["action"] = action
        td = env.step(td)
        steps.append(td["next"].clone())
        td = env.step_mdp(td)
    return torch.stack(steps)


@pytest.fixture(scope="module")
def fixed_actions():
    return torch.rand(120, 16, 6, generator=torch.Generator().manual_seed(0)) * 2 - 1


@pytest.fixture(scope="module")
def sixteen(fixed_actions):
    return play(make_env(16), fixed_actions)


@pytest.mark.parametrize(("first", "num_envs", "threads"), [(0, 16, 2), (0, 4, 1), (12, 4, 2), (5, 1, 1), (3, 7, 2)])
def test_the_same_actions_give_bit_identical_episodes(fixed_actions, sixteen, first, num_envs, threads):
    env = make_env(num_envs, num_threads=threads)
    env.start_from(first)
    rows = slice(first, first + num_envs)
    assert same(play(env, fixed_actions[:, rows]), sixteen[:, rows])


def test_another_seed_or_split_is_another_series_and_set_seed_starts_it():
    starts = {}
    for seed, split in ((0, "train"), (1, "train"), (0, "dev"), (0, "test")):
        starts[seed, split] = make_env(4, seed=seed, split=split).reset()["target_pos"]
    assert len({tuple(place.flatten().tolist()) for place in starts.values()}) == 4
    env = make_env(4)
    env.rollout(3)
    env.set_seed(1)
    assert torch.equal(env.reset()["target_pos"], starts[1, "train"])


def test_a_partial_reset_resets_the_masked_rows_alone_and_takes_the_next_episodes():
    env, actions = make_env(4), torch.zeros(4, 6) + 0.3
    td = env.reset()
    for _ in range(6):
        td = env.step_mdp(env.step(td.set("action", actions)))
    before = td.clone()
    reset = env.reset(td.clone().set("_reset", torch.tensor([[False], [True], [False], [True]])))
    assert reset["episode"].tolist() == [0, 4, 2, 5]
    assert reset["step_count"].tolist() == [[6], [0], [6], [0]]
    assert same(reset[[0, 2]].select(*before.keys()), before[[0, 2]])
    fresh = make_env(2)
    fresh.start_from(4)
    assert same(fresh.reset(), reset[[1, 3]].select(*fresh.reset().keys()))
    undisturbed = make_env(4)
    other = undisturbed.reset()
    for _ in range(6):
        other = undisturbed.step_mdp(undisturbed.step(other.set("action", actions)))
    for _ in range(5):
        reset = env.step_mdp(env.step(reset.set("action", actions)))
        other = undisturbed.step_mdp(undisturbed.step(other.set("action", actions)))
    assert same(other[[0, 2]], reset[[0, 2]])
    again = env.reset(reset.set("_reset", torch.tensor([[True], [False], [False], [False]])))
    assert again["episode"].tolist() == [6, 4, 2, 5]


def test_a_reset_leaves_what_was_returned_before_as_it_was():
    env = make_env(2)
    td = env.step(wave(env.reset()))
    copy = td.clone()
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    assert same(td, copy)


def whole_episodes(data):
    """Whole episodes in ``data`` (N, T), by their number."""
    found = {}
    for row in data.unbind(0):
        for episode in row["episode"].unique().tolist():
            part = row[row["episode"] == episode]
            if bool(part["next", "done"][-1]):
                found[episode] = part
    return found


def assert_as_if_alone(data, at_least, **settings):
    found = whole_episodes(data)
    assert len(found) >= at_least
    assert sorted(found)[: at_least // 2] == list(range(at_least // 2))
    for episode, part in found.items():
        env = make_env(1, **settings)
        env.start_from(episode)
        alone = env.rollout(len(part) + 5, wave)[0]
        assert same(alone, part.select(*alone.keys(include_nested=True, leaves_only=True)))


def test_auto_reset_goes_on_with_the_next_episodes():
    env, rows = make_env(3, max_steps=9), []
    td = env.reset()
    for _ in range(40):
        data, td = env.step_and_maybe_reset(wave(td))
        rows.append(data.clone())
    assert_as_if_alone(torch.stack(rows, dim=1), 12, max_steps=9)


def test_a_step_with_resets_is_torchrls_own():
    planner, (ours, theirs) = TargetPursuit(ik_planner()), (make_env(3, max_steps=5) for _ in range(2))
    own, other = ours.reset(), theirs.reset()
    for _ in range(12):
        own = ours.step_and_maybe_reset(planner(own))
        other = EnvBase.step_and_maybe_reset(theirs, planner(other))
        for one, two in zip(own, other, strict=True):
            assert set(one.keys(include_nested=True)) == set(two.keys(include_nested=True))
            assert same(one, two)
        own, other = own[1], other[1]


def test_a_collector_gathers_whole_episodes():
    settings = {"max_steps": 9, "velocity": 5.0}
    frames = {"frames_per_batch": 80, "total_frames": 240, "auto_register_policy_transforms": False}
    collector = Collector(lambda: make_env(4, **settings), wave, **frames)
    data = torch.cat([batch.clone() for batch in collector], dim=-1)
    collector.shutdown()
    assert_as_if_alone(data, 20, **settings)


def test_a_trapped_ball_was_covered_and_kept():
    env = make_env(12, static_target=True)
    rollout = env.rollout(250, TargetPursuit(ik_planner()), break_when_any_done=False, auto_reset=True)
    arm, trapped = Arm.ur5(tool_length=SCENE.tool_length), 0
    for part in whole_episodes(rollout).values():
        end = part["next"]
        pose = arm(end["joint_pos"])
        covered = is_covered(SCENE, end["tool_pos"], pose[:, :3, :3], end["target_pos"])
        assert end["trapped"][:-1].logical_not().all()
        assert (end["reward"][:-1] < 2.0).all()
        assert not end["trapped"][-1] or end["reward"][-1] > 20.0, "what it would have earned by staying is missing"
        assert torch.equal(end["terminated"], end["trapped"] | end["pocketed"])
        if bool(end["trapped"][-1]):
            trapped += 1
            assert covered[-HOLD_STEPS:].all()
            assert not covered[-HOLD_STEPS - 1]
    assert trapped >= 6
