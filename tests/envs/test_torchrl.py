"""What TorchRL's users take for granted of an environment, for every one of this package."""

import multiprocessing
import os

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import (
    CatFrames,
    CatTensors,
    ClipTransform,
    Compose,
    DoubleToFloat,
    DTypeCastTransform,
    EnvBase,
    ExcludeTransform,
    FlattenObservation,
    InitTracker,
    ObservationNorm,
    RandomTruncationTransform,
    RenameTransform,
    RewardScaling,
    RewardSum,
    SerialEnv,
    StepCounter,
    TimeMaxPool,
    TrajCounter,
    TransformedEnv,
    UnsqueezeTransform,
)
from torchrl.envs.utils import check_env_specs, step_mdp

from tests.envs.worlds import WORLDS
from torchdyn_plan import keys
from torchdyn_plan.errors import InputError

EACH = pytest.mark.parametrize("make", WORLDS.values(), ids=WORLDS.keys())

TRANSFORMS = {
    "cat frames": lambda: CatFrames(3, dim=-1, in_keys=["observation"], out_keys=["frames"]),
    "cat tensors": lambda: CatTensors(["observation", "target_pos"], "both", del_keys=False),
    "clip": lambda: ClipTransform(in_keys=["observation"], low=-1.0, high=1.0),
    "compose": lambda: Compose(InitTracker(), RewardSum()),
    "double": lambda: DTypeCastTransform(torch.float32, torch.float64, in_keys=["observation"]),
    "float": DoubleToFloat,
    "exclude": lambda: ExcludeTransform("target_history"),
    "flatten": lambda: FlattenObservation(-2, -1, in_keys=["target_history"], out_keys=["flat"]),
    "init tracker": InitTracker,
    "norm": lambda: ObservationNorm(0.5, 2.0, in_keys=["observation"]),
    "truncation": lambda: RandomTruncationTransform(min_horizon=3, max_horizon=9),
    "rename": lambda: RenameTransform(["observation"], ["state"]),
    "scale": lambda: RewardScaling(1.0, 2.0),
    "sum": RewardSum,
    "counter": lambda: StepCounter(max_steps=6),
    "pool": lambda: TimeMaxPool(in_keys=["observation"], out_keys=["most"], T=3),
    "trajectories": TrajCounter,
    "unsqueeze": lambda: UnsqueezeTransform(-1, in_keys=["observation"]),
}
"""TorchRL's own, one of each kind."""


def actions(env):
    """A policy that draws the same actions for the same seed."""
    draw = torch.Generator().manual_seed(1)

    def act(td):
        shape = env.action_spec.shape
        return td.set("action", 2.0 * torch.rand(shape, generator=draw) - 1.0)

    return act


def leaves(td):
    return td.items(include_nested=True, leaves_only=True)


def assert_same(one, other):
    assert set(one.keys(True)) == set(other.keys(True))
    for key, value in leaves(one):
        assert torch.equal(value, other[key]), key


@pytest.mark.parametrize("transform", TRANSFORMS.values(), ids=TRANSFORMS.keys())
@EACH
def test_specs_hold_under_every_transform(make, transform):
    check_env_specs(TransformedEnv(make(max_steps=4), transform()))


@pytest.mark.parametrize(
    "options", [{}, {"goal_in_observation": True}, {"num_envs": 1, "history": 2}, {"split": "dev", "seed": None}]
)
@EACH
def test_specs_hold_for_every_option(make, options):
    check_env_specs(make(**options))


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: TransformedEnv(env, RewardSum())], ids=["bare", "sum"])
@EACH
def test_a_step_with_a_reset_is_a_step_then_a_step_mdp_then_a_reset(make, wrap):
    ours, theirs = wrap(make(3, max_steps=7)), wrap(make(3, max_steps=7))
    one, other, act_one, act_other = ours.reset(), theirs.reset(), actions(ours), actions(theirs)
    for _ in range(16):
        stepped, one = ours.step_and_maybe_reset(act_one(one))
        taken = theirs.step(act_other(other))
        other = step_mdp(taken, exclude_action=False)
        if other["done"].any():
            other = theirs.reset(other.set("_reset", other["done"])).exclude("_reset")
        assert_same(stepped, taken)
        assert_same(one, other)


@EACH
def test_a_step_with_a_reset_is_torchrls_own(make):
    ours, theirs = make(3, max_steps=7), make(3, max_steps=7)
    one, other, act_one, act_other = ours.reset(), theirs.reset(), actions(ours), actions(theirs)
    for _ in range(16):
        stepped, one = ours.step_and_maybe_reset(act_one(one))
        taken, other = EnvBase.step_and_maybe_reset(theirs, act_other(other))
        assert_same(stepped, taken)
        assert_same(one, other)


@EACH
def test_a_policy_that_learns_can_be_rolled_out_and_leaves_no_graph_behind(make):
    env = make()
    sizes = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    policy = TensorDictModule(torch.nn.Linear(*sizes), ["observation"], ["action"])
    rollout = env.rollout(5, policy, break_when_any_done=False)
    assert rollout["action"].requires_grad, "the policy's own graph stays"
    for key, value in leaves(rollout["next"]):
        assert not value.requires_grad, key
    assert not env.rollout(3, break_when_any_done=False)["next", "observation"].requires_grad


@EACH
def test_what_was_returned_may_be_changed_in_place(make):
    ours, theirs = make(max_steps=4), make(max_steps=4)
    one, other, act_one, act_other = ours.reset(), theirs.reset(), actions(ours), actions(theirs)
    for _ in range(6):
        for key, value in leaves(one):
            old = {name: entry.clone() for name, entry in leaves(one) if name != key}
            value.copy_(~value if value.dtype == torch.bool else value + 1)
            for name, entry in old.items():
                assert torch.equal(one[name], entry), f"{key} and {name} share their memory"
        stepped, one = ours.step_and_maybe_reset(act_one(one))
        taken, other = theirs.step_and_maybe_reset(act_other(other))
        assert_same(stepped["next"], taken["next"])


@EACH
def test_copies_without_a_seed_play_other_episodes_under_other_numbers(make):
    env = SerialEnv(4, lambda: make(1, seed=None))
    start = env.reset()
    assert len(start["target_pos"].reshape(4, 3).unique(dim=0)) == 4
    assert len(start["episode"].unique()) == 4


@EACH
def test_a_seeded_series_starts_with_its_first_episode_and_a_seedless_one_can_be_played_again(make):
    env = make(seed=5)
    assert env.reset()["episode"].tolist() == [0, 1]
    env.set_seed(3)
    assert (env.reset()["episode"].tolist(), env.seed) == ([0, 1], 3)
    free = make(seed=None)
    first, start = free.next_episode, free.reset()
    again = make(seed=free.seed)
    again.start_from(first)
    assert_same(start, again.reset())


@EACH
def test_a_state_dict_goes_on_with_the_episodes_in_progress(make):
    first, second = make(max_steps=3), make(max_steps=3, seed=9)
    first.rollout(7, break_when_any_done=False)
    state, due = first.state_dict(), first.next_episode
    second.load_state_dict(state)
    start = second.reset()
    assert start["episode"].tolist() == [due - 2, due - 1]
    fresh = make(max_steps=3)
    fresh.start_from(due - 2)
    assert_same(start, fresh.reset())
    assert second.reset()["episode"].tolist() == [due, due + 1]
    with pytest.raises(InputError, match=r"episodes of the state must have shape \(\*B, 3\), got \(2,\)"):
        make(3).load_state_dict(state)


@EACH
def test_a_collector_of_workers_goes_on_where_its_state_was_saved(make):
    def build():
        env = SerialEnv(2, lambda: make(1, max_steps=5, seed=None))
        sizes = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
        policy = TensorDictModule(torch.nn.Linear(*sizes), ["observation"], ["action"])
        return Collector(env, policy, frames_per_batch=10, total_frames=100, auto_register_policy_transforms=False)

    first = build()
    steps = iter(first)
    for _ in range(3):
        next(steps)
    # Later in the batch an episode may end early, and which does is up to the policy.
    state, expected = first.state_dict(), next(steps)["episode"][..., 0]
    second = build()
    second.load_state_dict(state)
    second.reset()
    assert torch.equal(next(iter(second))["episode"][..., 0], expected)
    first.shutdown()
    second.shutdown()


@EACH
def test_collectors_cut_trajectories_by_torchrls_own_counter(make):
    env = TransformedEnv(make(), ExcludeTransform("step_count"))
    settings = {"frames_per_batch": 20, "total_frames": 20, "auto_register_policy_transforms": False}
    collector = Collector(env, actions(env), max_frames_per_traj=5, **settings)
    data = next(iter(collector))
    collector.shutdown()
    assert data["next", "done"].squeeze(-1)[:, 4::5].all()


@EACH
def test_one_bad_action_holds_its_row_where_that_is_wished_and_is_an_error_else(make):
    holding, usual = make(3, on_bad_action="hold"), make(3)
    action = actions(usual)(usual.reset())["action"]
    held, spoiled = action.clone(), action.clone()
    held[1], spoiled[1, 0] = 0.0, float("nan")
    found = holding.step(holding.reset().set("action", spoiled))["next"]
    other = make(3)
    assert_same(found, other.step(other.reset().set("action", held))["next"])
    with pytest.raises(InputError, match="action must be finite, got 1 NaN"):
        usual.step(usual.reset().set("action", spoiled))


def test_an_environment_in_a_forked_process_says_so_and_does_not_hang():
    env = WORLDS["trapper"](num_threads=2)
    env.rollout(2)
    reader, writer = multiprocessing.Pipe(duplex=False)

    def use():
        try:
            env.reset()
        except InputError as error:
            writer.send(str(error))

    child = multiprocessing.get_context("fork").Process(target=use)
    child.start()
    assert reader.poll(60), "it hangs"
    assert f"was built in process {os.getpid()}, and process {child.pid} uses it" in reader.recv()
    child.join()


@EACH
def test_an_observation_can_show_the_goal(make):
    env = make(goal_in_observation=True, max_steps=30)
    rollout = env.rollout(6, actions(env), break_when_any_done=False)
    state, observation = rollout["robot_state"], rollout["observation"]
    size = state.shape[-1]
    assert torch.equal(observation[..., :size], state)
    assert torch.equal(observation[..., size : size + 3], rollout["desired_goal"])
    if not env.static_target:
        history = rollout["target_history"]
        assert torch.equal(observation[..., size + 3 :], history[..., -1, :] - history[..., -2, :])
    assert torch.equal(rollout["next", "observation"][:, :-1], observation[:, 1:])


@EACH
def test_the_history_counts_the_sample_of_now(make):
    env = make(max_steps=30, history=4)
    rollout = env.rollout(8, actions(env), break_when_any_done=False)
    assert rollout["history_length"].tolist() == [[1, 2, 3, 4, 4, 4, 4, 4]] * 2
    assert torch.equal(rollout["target_history"][:, :, -1], rollout["target_pos"])


def test_the_goal_environment_shows_no_ball_but_its_goal():
    rollout = WORLDS["goals"](max_steps=100).rollout(60)
    assert torch.equal(rollout[keys.TARGET_POS], rollout[keys.DESIRED_GOAL])
    assert torch.equal(rollout[keys.TARGET_POS], rollout[keys.GOAL])
    assert (rollout[keys.TARGET_POS].diff(dim=1) != 0).any(), "no goal has changed"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@EACH
def test_entries_are_shown_on_the_device_that_was_asked_for(make):
    env, plain = make(device="cuda"), make()
    check_env_specs(env)
    shown, seen = (
        env.rollout(4, lambda td: td.set("action", env.action_spec.zero())),
        plain.rollout(4, lambda td: td.set("action", plain.action_spec.zero())),
    )
    assert shown.device.type == "cuda"
    assert_same(shown.cpu(), seen)


def test_an_unknown_render_mode_and_a_picture_that_was_not_asked_for_are_refused():
    with pytest.raises(InputError, match="unknown render_mode 'human'"):
        WORLDS["trapper"](render_mode="human")
    with pytest.raises(InputError, match="unknown on_bad_action 'halt'"):
        WORLDS["trapper"](on_bad_action="halt")
    with pytest.raises(InputError, match="made with render_mode='rgb_array', got None"):
        WORLDS["trapper"]().render()
    with pytest.raises(InputError, match="PointEnv draws no pictures"):
        WORLDS["points"](render_mode="rgb_array").render()
