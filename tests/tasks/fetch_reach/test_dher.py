import itertools

import pytest
import torch
from tensordict import TensorDict

from torchdyn_plan.envs.fetch_reach.env import reach_reward
from torchdyn_plan.errors import InputError
from torchdyn_plan.tasks.fetch_reach.dher import DynamicHindsightReplayBuffer, cells_of

LENGTH = 9


def random_episodes(count, seed, *, successes=()):
    """Grippers that wander and goals that move, in a room so small that they often share a cell."""
    draw = torch.Generator().manual_seed(seed)
    flat = torch.tensor([1.0, 1.0, 0.0])
    walk = 0.012 * torch.randn(count, LENGTH + 1, 3, generator=draw).cumsum(1)
    tool = flat * (0.05 * torch.rand(count, 1, 3, generator=draw) + walk) + torch.tensor([0.0, 0.0, 0.009])
    way = torch.arange(LENGTH + 1.0).view(1, -1, 1) * torch.rand(count, 1, 1, generator=draw)
    goal = flat * 0.05 * torch.rand(count, 1, 3, generator=draw) + 0.01 * way * torch.tensor([1.0, 0.0, 0.0])
    # Half a cell lower or higher: in the same cell, and yet not at the goal.
    goal[..., 2] = 0.0145
    tool[..., 2] = 0.0055
    for row in successes:
        goal[row, 4] = tool[row, 4]
    after = (tool[:, 1:], goal[:, 1:])
    reached = reach_reward(*after, threshold=0.005)
    following = {"achieved_goal": after[0], "desired_goal": after[1], "reward": reached}
    entries = {"desired_goal": goal[:, :-1], "tag": torch.arange(count * LENGTH).view(count, LENGTH), "next": following}
    return TensorDict(entries, batch_size=[count, LENGTH])


def reward(transitions):
    return reach_reward(transitions["next", "achieved_goal"], transitions["next", "desired_goal"], threshold=0.005)


def make_buffer(episodes, **settings):
    generator = torch.Generator().manual_seed(7)
    settings = {"capacity": 10_000, "length": LENGTH, "batch_size": 64, "generator": generator, **settings}
    buffer = DynamicHindsightReplayBuffer(reward, **settings)
    buffer.extend(episodes)
    return buffer


def slow_pairs(episodes):
    """The matching as one would explain it: every pair of moments looked at."""
    achieved, desired = episodes["next", "achieved_goal"], episodes["next", "desired_goal"]
    pairs = set()
    for i in range(len(episodes)):
        for p in range(LENGTH):
            for j in range(len(episodes)):
                if i == j or bool((episodes["next", "reward"][j] >= 0).any()):
                    continue
                for q in range(LENGTH):
                    here = [f"{x:.2f}" for x in achieved[i, p].tolist()]
                    there = [f"{x:.2f}" for x in desired[j, q].tolist()]
                    if [x.replace("-0.00", "0.00") for x in here] == [x.replace("-0.00", "0.00") for x in there]:
                        pairs.add((i * LENGTH + p, j * LENGTH + q))
    return pairs


def all_pairs(matches):
    return {
        (int(matches.achieved[row]), int(matches.partner(torch.tensor([row]), torch.tensor([number]))))
        for row in range(len(matches.achieved))
        for number in range(int(matches.partners[row]))
    }


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("successes", [(), (2, 5)])
def test_matches_are_those_of_a_slow_obvious_search(seed, successes):
    episodes = random_episodes(12, seed, successes=successes)
    matches = make_buffer(episodes).matches
    expected = slow_pairs(episodes)
    assert len(expected) > 20
    assert all_pairs(matches) == expected
    assert int(matches.partners.sum()) == len(expected)
    cell = cells_of(episodes["next", "achieved_goal"].flatten(0, 1), 0.01)[matches.achieved]
    starts = matches.cell_start.tolist()
    groups = [set(cell[a:b].tolist()) for a, b in itertools.pairwise(starts)]
    assert all(len(group) == 1 for group in groups)
    assert len(set.union(*groups)) == len(groups)


def test_draws_are_pairs_moved_back_together_and_every_pair_is_drawn():
    episodes = random_episodes(8, 1)
    buffer, pairs = make_buffer(episodes), slow_pairs(episodes)
    allowed = {(a - s, d - s) for a, d in pairs for s in range(min(a % LENGTH, d % LENGTH) + 1)}
    moved, goals = buffer.draw_pairs(60_000)
    drawn = set(zip(moved.tolist(), goals.tolist(), strict=True))
    assert drawn == allowed


def test_every_cell_is_as_likely_as_any_other():
    episodes = random_episodes(8, 1)
    buffer = make_buffer(episodes)
    cells = cells_of(episodes["next", "achieved_goal"].flatten(0, 1), 0.01)
    found, first = buffer.matches, []
    buffer._integers, draw = lambda bound: first.append(bound) or draw(bound), buffer._integers
    buffer.draw_pairs(10)
    assert first[0].unique().tolist() == [len(cells[found.achieved].unique())]


@pytest.mark.parametrize(("success", "relabelled"), [(0.0, 51), (0.5, 25), (1.0, 0)])
def test_a_sample_has_its_share_of_other_goals_and_rewards_that_fit(success, relabelled):
    episodes = random_episodes(12, 3)
    buffer, flat = make_buffer(episodes), episodes.reshape(-1)
    goals = torch.cat([flat["desired_goal"], flat["next", "desired_goal"]], dim=-1)
    batch = buffer.sample(success=success)
    assert torch.equal(batch["next", "reward"], reward(batch))
    given = torch.cat([batch["desired_goal"], batch["next", "desired_goal"]], dim=-1)
    own = (given == goals[batch["tag"]]).all(-1)
    assert own[relabelled:].all()
    assert not own[:relabelled].any()
    for row in range(relabelled):
        assert (given[row] == goals).all(-1).any(), "goals of one moment of another episode"
    assert torch.equal(batch["next", "achieved_goal"], flat["next", "achieved_goal"][batch["tag"]])


def test_what_is_stored_stays_as_it_was():
    episodes = random_episodes(12, 3)
    buffer = make_buffer(episodes)
    for _ in range(5):
        buffer.sample()["desired_goal"].zero_()
    flat = episodes.reshape(-1)
    for name, value in buffer.tensors().items():
        if name != "recent":
            assert torch.equal(value, flat[tuple(name.split("."))]), name


def test_recent_success_is_counted_over_the_latest_episodes():
    buffer = make_buffer(random_episodes(12, 3, successes=(10, 11)), recent=4)
    assert buffer.recent_success == 0.5
    buffer.extend(random_episodes(3, 4))
    assert buffer.recent_success == 0.25


def test_a_full_buffer_overwrites_whole_episodes_and_matches_anew():
    first, second = random_episodes(6, 0), random_episodes(4, 1)
    buffer = make_buffer(first, capacity=6 * LENGTH + 5)
    assert len(buffer.matches.achieved)
    buffer.extend(second)
    kept = torch.cat([second, first[4:]])
    assert all_pairs(buffer.matches) == slow_pairs(kept)


def test_without_a_match_everything_is_plain():
    episodes = random_episodes(3, 0)
    episodes["next", "desired_goal"] += 5.0
    batch = make_buffer(episodes).sample(success=0.0)
    assert torch.equal(batch["next", "desired_goal"], episodes["next", "desired_goal"].flatten(0, 1)[batch["tag"]])


def test_a_buffer_comes_back_as_it_was():
    buffer = make_buffer(random_episodes(6, 0, successes=(5,)), capacity=8 * LENGTH)
    buffer.extend(random_episodes(4, 1))
    again = DynamicHindsightReplayBuffer(reward, capacity=8 * LENGTH, length=LENGTH, batch_size=64)
    again.restore(buffer.tensors(), buffer.cursor)
    assert (again.cursor, again.recent_success) == (buffer.cursor, buffer.recent_success)
    assert all_pairs(again.matches) == all_pairs(buffer.matches)


@pytest.mark.parametrize(
    ("settings", "named"), [({"capacity": 4}, "capacity"), ({"ratio": 1.5}, "ratio"), ({"cell": 0.0}, "cell")]
)
def test_bad_settings_are_named(settings, named):
    with pytest.raises(InputError, match=named):
        make_buffer(random_episodes(2, 0), **settings)


def test_episodes_of_another_length_are_named():
    with pytest.raises(InputError, match=r"9 transitions, got a batch of \(2, 4\)"):
        make_buffer(random_episodes(2, 0)[:, :4])
