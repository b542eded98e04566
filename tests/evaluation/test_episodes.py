import dataclasses

import pytest
import torch

from tests.evaluation.untrained import untrained
from tests.planners.test_schedule import PAPER_STEPS
from tests.planners.toy import StraightArrival
from torchdyn_plan import keys
from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.envs.trapper.contact import is_pocketed
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.evaluation.episodes import ShownTruth, find_truth, run_episodes
from torchdyn_plan.planners import (
    CallablePlanner,
    CornerSearch,
    DynamicPlanner,
    ReplanSchedule,
    TargetPursuit,
    oracle_trajectory,
)
from torchdyn_plan.tasks.task import Truth
from torchdyn_plan.tasks.trapper import solvable as solvability
from torchdyn_plan.tasks.trapper.solvable import ArrivalMap
from torchdyn_plan.tasks.trapper.task import TASK, ik_planner

SCENE = TrapperScene()
SOON = ReplanSchedule(first_step=3, window=7, minimum=5)
SETTINGS = TASK.default_settings()
FIELDS = ("success", "steps", "replans", "solvable", "cause")


def shorter(steps):
    """Trapper with episodes of so many control steps."""

    def make_env(settings, **batch):
        return TrapperEnv(velocity=settings.velocity, friction=settings.friction, max_steps=steps, **batch)

    return dataclasses.replace(TASK, make_env=make_env)


def stand_still():
    return CallablePlanner(lambda state, goal: torch.zeros(*goal.shape[:-1], 6))


class Watched:
    """A planner, and what it was shown at each step of each episode."""

    def __init__(self, planner, in_keys=()):
        self.planner, self.in_keys, self.seen = planner, list(in_keys), {}

    def __call__(self, td):
        for row in td.unbind(0):
            self.seen[int(row["episode"]), int(row["step_count"])] = row.clone()
        return self.planner(td)

    def path(self, episode):
        steps = sorted(step for number, step in self.seen if number == episode)
        assert steps == list(range(len(steps)))
        return torch.stack([self.seen[episode, step]["target_pos"] for step in steps])


class StillPursuit:
    """Wants nothing and stays where it is; reads only what is named."""

    def __call__(self, td):
        return stand_still()(td.set("goal", td["target_pos"]))


@pytest.fixture(scope="module")
def truth():
    """Recorded futures of 16 episodes, where the arm is everywhere after 200 steps."""
    everywhere = ArrivalMap(torch.full((3, 3), 200), SCENE.half_side)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solvability, "arrival_map", lambda *_, **__: everywhere)
        return find_truth(TASK, SETTINGS, episodes=16, seed=0, split="dev", num_threads=1)


def play(planner, truth, *, task=TASK, episodes=16, num_envs=16, num_threads=1):
    known = Truth(truth.future, truth.solvable[:episodes])
    how = {"episodes": episodes, "split": "dev", "num_envs": num_envs, "num_threads": num_threads}
    return run_episodes(planner, task, SETTINGS, known, progress=False, **how)


def test_the_truth_is_as_long_as_an_oracle_may_look_and_says_what_is_solvable(truth):
    future, solvable = truth
    assert future.shape == (16, 801, 3)
    alive = ~is_pocketed(SCENE, future[:, 200])
    assert torch.equal(solvable, alive)
    assert alive.any()
    assert not alive.all()


def pursuit():
    return TargetPursuit(ik_planner(chunk=16))


@pytest.mark.parametrize(("planner", "others"), [(pursuit, [(7, 2), (4, 1)]), (untrained, [(7, 1)])])
def test_outcomes_do_not_depend_on_environments_or_threads(truth, planner, others):
    task = shorter(150)
    expected = play(planner(), truth, task=task)
    assert expected.flags.keys() == {"pocketed", "touched"}
    if planner is pursuit:
        assert expected.success.any()
        assert expected.flags["touched"].any()
    for num_envs, threads in others:
        other = play(planner(), truth, task=task, num_envs=num_envs, num_threads=threads)
        for name in FIELDS:
            assert torch.equal(getattr(other, name), getattr(expected, name)), (name, num_envs)
        for name, clue in (expected.flags | expected.evidence).items():
            assert torch.equal((other.flags | other.evidence)[name], clue), name


def test_a_run_is_always_its_first_episodes(truth):
    planner = Watched(StillPursuit())
    outcome = play(planner, truth, task=shorter(6), episodes=8, num_envs=3)
    assert outcome.episodes == 8
    assert outcome.steps.tolist() == [-1] * 8
    place, _ = draw_starts(SCENE, torch.arange(8), velocity=3.0, split="dev", seed=0)
    for episode in range(8):
        path = planner.path(episode)
        assert len(path) == 6
        torch.testing.assert_close(path[0, :2].double(), place[episode], atol=1e-6, rtol=0)


def test_more_environments_than_episodes_are_not_made(truth):
    planner = Watched(StillPursuit())
    play(planner, truth, task=shorter(6), episodes=2, num_envs=50)
    assert {episode for episode, _ in planner.seen} == {0, 1}


@pytest.mark.parametrize("reads", [True, False])
def test_the_recorded_truth_is_shown_to_those_who_read_it_and_is_true(truth, reads):
    planner = Watched(StillPursuit(), [keys.TARGET_FUTURE] if reads else [keys.TARGET_POS])
    play(planner, truth, task=shorter(60), episodes=8, num_envs=3)
    assert len(planner.seen) > 300
    for (_, step), row in planner.seen.items():
        assert (keys.TARGET_FUTURE in row.keys()) is reads  # noqa: SIM118
        if reads:
            torch.testing.assert_close(row[keys.TARGET_FUTURE][step], row["target_pos"], atol=1e-6, rtol=0)


def test_an_oracle_plans_on_the_balls_true_future(truth):
    forecasts = {}

    def search(forecast, target_pos, eta, context):
        for row, place in zip(forecast.path, target_pos, strict=True):
            forecasts[tuple(place.tolist())] = row
        return CornerSearch()(forecast, target_pos, eta, context)

    oracle = oracle_trajectory(stand_still(), StraightArrival(), search=search, schedule=SOON, horizon=40)
    planner = Watched(oracle, oracle.in_keys)
    play(planner, truth, task=shorter(60), episodes=4, num_envs=2)
    checked = 0
    for episode in range(4):
        path = planner.path(episode)
        for step in range(len(path) - 1):
            forecast = forecasts.get(tuple(path[step].tolist()))
            if forecast is not None:
                ahead = path[step + 1 : step + 41]
                torch.testing.assert_close(forecast[: len(ahead)], ahead, atol=1e-6, rtol=0)
                checked += len(ahead)
    assert checked > 200


def test_replans_are_counted_for_each_episode(truth):
    planner = Watched(untrained())
    outcome = play(planner, truth, task=shorter(200), episodes=6, num_envs=3)
    lengths = [len(planner.path(episode)) for episode in range(6)]
    expected = [sum(step < length for step in PAPER_STEPS) for length in lengths]
    assert outcome.replans.tolist() == expected
    assert 4 in expected
    assert play(StillPursuit(), truth, task=shorter(200), episodes=2).replans.tolist() == [0, 0]


def test_a_whole_episode_plans_at_exactly_the_papers_steps(truth):
    episode = int((~is_pocketed(SCENE, truth.future[:, 500])).int().argmax())
    env = TrapperEnv(1, split="dev", seed=0, num_threads=1)
    env.start_from(episode)
    planner = DynamicPlanner.paper(stand_still(), lambda history: history, StraightArrival())
    rollout = env.rollout(500, planner)[0]
    assert len(rollout) == 500
    planned = rollout["plan", "replanned"].nonzero().squeeze(-1).tolist()
    assert planned == [13, 80, 140, 194, 242, 285, 323, 357, 387, 414, 439, 464, 489]
    assert planned == PAPER_STEPS


def test_a_still_arm_traps_nothing_and_pockets_end_episodes(truth):
    outcome = play(StillPursuit(), truth)
    sunk = is_pocketed(SCENE, truth.future[:, :501]).any(-1)
    assert torch.equal(outcome.flags["pocketed"], sunk)
    assert not outcome.success.any()
    assert not outcome.flags["touched"].any()
    names = [TASK.causes[cause] for cause in outcome.cause]
    for name, solvable, pocketed in zip(names, truth.solvable, sunk, strict=True):
        assert name == ("unreachable" if not solvable else "pocketed" if pocketed else "late")
    assert set(names) == {"unreachable", "pocketed", "late"}


def test_a_ball_that_leaves_its_recorded_path_was_touched_or_trapped(truth):
    goal = torch.tensor([0.05, -0.25, SCENE.ball_radius])
    planner = ik_planner(chunk=16)
    watched = Watched(lambda td: planner(td.set("goal", goal.expand(*td.batch_size, 3))))
    outcome = play(watched, truth)
    paths = [watched.path(episode) for episode in range(16)]
    off = [(path - truth.future[i, : len(path)]).norm(dim=-1).max() for i, path in enumerate(paths)]
    moved = torch.stack(off) > 0.002
    assert (outcome.flags["touched"] | outcome.success)[moved].all()
    assert (moved & outcome.flags["touched"] & ~outcome.success).any()
    assert not (outcome.flags["touched"] | outcome.success | moved).all()
    assert torch.equal(outcome.steps > 0, outcome.success)
    lengths = torch.tensor([len(path) for path in paths])
    assert torch.equal(outcome.steps[outcome.success], lengths[outcome.success])


def test_the_truth_stays_true_when_a_ball_is_touched(truth):
    env = TrapperEnv(2, velocity=3.0, seed=0, split="dev", num_threads=1)
    planner = Watched(StillPursuit(), [keys.TRUE_FUTURE])
    shown, td = ShownTruth(planner, env, truth.future), env.reset()
    still = torch.zeros(2, 6)
    for _ in range(20):
        td = env.step_mdp(env.step(td.set("action", still)))
    shown.show(td)
    torch.testing.assert_close(td[keys.TRUE_FUTURE][:, 0], truth.future[td["episode"], 21], atol=1e-3, rtol=0)
    # Somebody kicks the first ball; the other one is left alone.
    env.simulation.ball_vel[0, :2] *= -0.5
    for _ in range(10):
        td = env.step_mdp(env.step(td.set("action", still)))
    shown.show(td)
    future = td[keys.TRUE_FUTURE].clone()
    for ahead in range(60):
        td = env.step_mdp(env.step(td.set("action", still)))
        torch.testing.assert_close(future[:, ahead], td["target_pos"], atol=2e-3, rtol=0)
    recorded = truth.future[td["episode"], 90]
    assert (td["target_pos"] - recorded)[0].norm() > 0.1, "the recording is no longer true"
    assert (td["target_pos"] - recorded)[1].norm() < 2e-3
