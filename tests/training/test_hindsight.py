"""Hindsight replay: every relabelled transition is checked against the episode that it comes from."""

import pytest
import torch
from tensordict import TensorDict

from torchdyn_plan import keys
from torchdyn_plan.errors import InputError
from torchdyn_plan.training.hindsight import HindsightReplayBuffer

LENGTH, STATES = 7, 4


def reward(transitions: TensorDict) -> torch.Tensor:
    """Distance from what was achieved to the goal, so that every pair of them has another reward."""
    return (transitions["next", keys.ACHIEVED_GOAL] - transitions[keys.DESIRED_GOAL]).norm(dim=-1, keepdim=True)


def episodes(first: int, count: int) -> TensorDict:
    """Whole episodes whose tensors tell episode and step: achieved goals are (episode, step + 1, 0)."""
    number = torch.arange(first, first + count).float()[:, None].expand(count, LENGTH)
    step = torch.arange(LENGTH).float().expand(count, LENGTH)
    achieved = torch.stack([number, step + 1, torch.zeros_like(step)], -1)
    goal = torch.stack([number, torch.full_like(step, 100.0), (step > 3).float()], -1)
    done = (step == LENGTH - 1).unsqueeze(-1)
    entries = TensorDict(
        {
            keys.OBSERVATION: torch.stack([number, step, number, step], -1),
            keys.DESIRED_GOAL: goal,
            keys.ACTION: torch.zeros(count, LENGTH, 2),
            "next": {
                keys.OBSERVATION: torch.stack([number, step + 1, number, step + 1], -1),
                keys.ACHIEVED_GOAL: achieved,
                keys.DESIRED_GOAL: goal.roll(-1, 1),
                "done": done,
                "terminated": torch.zeros_like(done),
            },
        },
        batch_size=[count, LENGTH],
    )
    entries["next", "reward"] = reward(entries)
    return entries


def check(sample: TensorDict, her_rows: int, present: range) -> None:
    """Transition by transition: the goal is the own or an achieved one of the same episode's future; rewards fit."""
    number, step = sample[keys.OBSERVATION][:, 0], sample[keys.OBSERVATION][:, 1]
    goal = sample[keys.DESIRED_GOAL]
    assert set(number.int().tolist()) <= set(present)
    torch.testing.assert_close(goal[:, 0], number, msg="a goal is of another episode")
    assert (goal[:her_rows, 1] >= step[:her_rows] + 1).all(), "a goal is of the past"
    assert (goal[:her_rows, 1] <= LENGTH).all()
    assert (goal[her_rows:, 1] == 100.0).all(), "a goal that should be left was replaced"
    assert torch.equal(sample["next", keys.DESIRED_GOAL], goal)
    assert torch.equal(sample["next", "reward"], reward(sample))


@pytest.mark.parametrize("blocks", [1, 2, 5, 9])
def test_relabels_within_the_episode_before_and_after_the_storage_wraps(blocks: int) -> None:
    torch.manual_seed(blocks)
    buffer = HindsightReplayBuffer(reward, capacity=6 * LENGTH + 3, length=LENGTH, batch_size=64)
    for block in range(blocks):
        buffer.extend(episodes(4 * block, 4))
    stored = min(4 * blocks, 6)
    assert len(buffer) == stored * LENGTH
    for _ in range(20):
        check(buffer.sample(), int(64 * 0.8), range(4 * blocks - stored, 4 * blocks))


def test_goals_are_spread_over_the_whole_future() -> None:
    torch.manual_seed(0)
    buffer = HindsightReplayBuffer(reward, capacity=LENGTH, length=LENGTH, batch_size=4000, her_ratio=1.0)
    buffer.extend(episodes(0, 1))
    sample = buffer.sample()
    first = sample[keys.OBSERVATION][:, 1] == 0
    counts = torch.bincount(sample[keys.DESIRED_GOAL][first, 1].long(), minlength=LENGTH + 1)[1:]
    assert counts.min() > 0.6 * counts.float().mean()


def test_restored_buffer_gives_the_same_samples() -> None:
    buffer, copy = (HindsightReplayBuffer(reward, capacity=6 * LENGTH, length=LENGTH, batch_size=16) for _ in range(2))
    for block in range(2):
        buffer.extend(episodes(4 * block, 4))
    copy.restore(buffer.tensors(), buffer.cursor)
    for kept in (buffer, copy):
        kept.extend(episodes(50, 1))
    samples = []
    for kept in (buffer, copy):
        torch.manual_seed(3)
        samples.append(kept.sample())
    assert (samples[0] == samples[1]).all()
    assert buffer.cursor == copy.cursor


def test_refuses_what_is_no_whole_episode() -> None:
    with pytest.raises(InputError, match="capacity must hold an episode of 7 transitions, got 6"):
        HindsightReplayBuffer(reward, capacity=6, length=LENGTH, batch_size=16)
    buffer = HindsightReplayBuffer(reward, capacity=70, length=LENGTH, batch_size=16)
    with pytest.raises(InputError, match=r"episodes must have 7 transitions, got a batch of \(2, 5\)"):
        buffer.extend(episodes(0, 2)[:, :5])
    flat = episodes(0, 4).reshape(-1)
    with pytest.raises(InputError, match=r"whole episodes of 7, got a batch of \(20,\)"):
        buffer.extend(flat[3:23])
    with pytest.raises(InputError, match="whole episodes of 7, got some that end elsewhere"):
        buffer.extend(flat[3:24])
    with pytest.raises(InputError, match="whole episodes of 7, got one"):
        buffer.add(flat[0])
    assert len(buffer) == 0


def test_takes_what_torchrls_loops_have() -> None:
    one, other = (HindsightReplayBuffer(reward, capacity=6 * LENGTH, length=LENGTH, batch_size=16) for _ in range(2))
    one.extend(episodes(0, 4))
    other.extend(episodes(0, 4).reshape(-1))
    for name, value in one.tensors().items():
        assert torch.equal(value, other.tensors()[name]), name
    assert other.sample().batch_size == (16,)
