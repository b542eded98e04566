"""How the box comes to its goal, and that every number of it follows the scene."""

import dataclasses
import math

import pytest
import torch

from tests.planners.follower import APPROACH, BASE, DOUBLE, SCENE, goals, home, tool
from torchdyn_plan.envs import TrapperEnv, TrapperScene
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import upright_error
from torchdyn_plan.planners import TargetPursuit
from torchdyn_plan.tasks.trapper.approach import BoxApproach
from torchdyn_plan.tasks.trapper.task import ik_planner, policy_planner
from torchdyn_plan.tasks.trapper.wait_and_drop import Drop, WaitAndDrop, waiting_search

OTHERS = [TrapperScene(base_setback=0.16), TrapperScene(table_side=1.4), TrapperScene(ball_radius=0.03)]


def test_it_keeps_the_box_clear_of_rails_and_ball():
    assert APPROACH.half_extent <= SCENE.half_side - SCENE.box_outer
    assert APPROACH.travel_height > 2 * SCENE.ball_radius
    assert APPROACH.clear_height > 2 * SCENE.ball_radius
    assert APPROACH.clear_height <= APPROACH.travel_height
    assert APPROACH.on_table_below >= SCENE.ball_radius
    assert 0 < APPROACH.down_height < SCENE.ball_radius
    # A box that drops from there, straight at its goal, comes down past a ball at rest without touching it.
    lift = APPROACH.travel_height - APPROACH.down_height
    away = torch.linspace(0.0, APPROACH.drop_distance, 50, dtype=torch.float64)
    mouth = APPROACH.down_height + lift * away / APPROACH.drop_distance
    wall = (SCENE.box_half_width - away).clamp_min(0.0)
    ball = SCENE.ball_radius + (SCENE.ball_radius**2 - wall**2).clamp_min(0.0).sqrt()
    assert (mouth - ball)[wall < SCENE.ball_radius].min() > 0
    assert APPROACH.max_radius < 0.425 + 0.39225 + 0.10915
    here = tool(home())
    assert here[2] >= APPROACH.clear_height
    assert here[:2].abs().max() <= APPROACH.half_extent
    assert APPROACH.min_radius <= (here - BASE)[:2].norm() <= APPROACH.max_radius
    assert upright_error(DOUBLE.arm(home(dtype=torch.float64))[:3, :3]).abs().max() < 1e-3


def test_in_the_calibrated_scene_they_are_the_numbers_of_the_published_results():
    assert dataclasses.asdict(APPROACH) == {
        "base_pos": (0.0, -0.855, 0.05),
        "on_table_below": 0.052,
        "travel_height": 0.099,
        "clear_height": 0.089,
        "half_extent": 0.722,
        "down_height": 0.006,
        "drop_distance": 0.045,
        "drop_margin": 0.015,
        "lift_margin": 0.02,
        "min_radius": 0.1,
        "max_radius": 0.91,
    }
    maneuver = WaitAndDrop.of(SCENE)
    assert (maneuver.drop, maneuver.drop_height, maneuver.half_extent) == (Drop.of(SCENE), 0.042, 0.722)
    assert (maneuver.pull, maneuver.aim_ahead_steps) == (0.044, 7)
    likely, certain = waiting_search(SCENE), waiting_search(SCENE, by_probability=False)
    for search in (likely, certain):
        assert (search.height, search.half_extent, search.footprint) == (0.105, 0.722, 0.055)
        assert (search.base_pos, search.descent_steps, search.longest_dwell) == ((0.0, -0.855), 7.0, 12)
        assert (search.waiting_cost, search.switching_cost, search.arrival_radius) == (0.01, 8.0, 0.015)
    assert (likely.probability_weight, likely.margin) == (30.0, 5.0)
    assert (certain.probability_weight, certain.margin) == (0.0, 15.0)


@pytest.mark.parametrize("scene", OTHERS)
def test_they_follow_another_scene(scene):
    approach, maneuver, search = BoxApproach.of(scene), WaitAndDrop.of(scene), waiting_search(scene)
    assert approach.base_pos == pytest.approx(scene.base_pos)
    assert approach.half_extent == pytest.approx(scene.half_side - scene.box_outer - 0.004)
    assert approach.travel_height == pytest.approx(2 * scene.ball_radius + 0.015)
    assert approach.clear_height == pytest.approx(2 * scene.ball_radius + 0.005)
    assert approach.on_table_below == pytest.approx(scene.goal_on_table_below)
    assert maneuver.half_extent == search.half_extent == approach.half_extent
    assert maneuver.drop_height == maneuver.drop.radius == scene.ball_radius
    assert search.base_pos == approach.base_pos[:2]
    assert search.height == pytest.approx(2 * scene.ball_radius + 0.021)
    assert search.footprint == pytest.approx(scene.box_half_width - 0.01)
    assert ik_planner(scene).approach == policy_planner(scene).approach == approach
    assert approach != APPROACH


def trapped(scene, planner, count=48, steps=250):
    """Share of resting balls that ``planner`` traps in ``scene``."""
    env = TrapperEnv(count, velocity=0.0, seed=0, split="dev", scene=scene, num_threads=1)
    found, td = torch.zeros(count, dtype=torch.bool), env.reset()
    for _ in range(steps):
        stepped, td = env.step_and_maybe_reset(planner(td))
        found |= stepped["next", "trapped"].squeeze(-1) & (stepped["episode"] < count)
    return float(found.double().mean())


@pytest.mark.parametrize("scene", OTHERS[:2])
def test_resting_balls_are_trapped_in_another_scene(scene):
    assert trapped(scene, TargetPursuit(ik_planner(scene, chunk=48))) >= 0.4


def test_an_arm_that_takes_itself_to_be_elsewhere_traps_less():
    planner = TargetPursuit(ik_planner(TrapperScene(), chunk=48))
    assert trapped(OTHERS[0], planner) < 0.1


def test_a_stretched_arm_keeps_its_height_when_noise_shakes_its_goal():
    middle, draw = torch.tensor([0.0, 0.05, 0.105]), torch.Generator().manual_seed(0)
    shakes = 0.006 * torch.randn(40, 8, 3, generator=draw) * torch.tensor([1.0, 1.0, 0.0])
    off = []
    for planner in (ik_planner(SCENE, chunk=32), ik_planner(SCENE, chunk=32).for_noise(0.002)):
        env = TrapperEnv(8, velocity=1.0, seed=0, split="dev", num_threads=1)
        td, heights = env.reset(), []
        for shake in shakes:
            td["goal"] = middle + shake
            for _ in range(5):
                td = env.step_and_maybe_reset(planner(td))[1]
                heights.append(td["tool_pos"][:, 2])
        off.append((torch.stack(heights[100:]) - middle[2]).abs().amax(0).mean())
    assert off[0] > 0.03
    assert off[1] < 0.4 * off[0], off


def heading(goal, approach=APPROACH, at=None):
    """Twist of an upright, square box whose mouth is ``at`` (3,) [m, world], above ``goal`` (3,) by default."""
    place = (approach.within_reach(goal) if at is None else at) - torch.tensor(approach.base_pos)
    down = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    pose = torch.cat([down, place.unsqueeze(-1)], dim=-1).flatten().unbind()
    return torch.stack([torch.as_tensor(value) for value in approach.twist(pose, goal.unbind())])


def mouth_height(goal):
    """Height at which the box mouth comes to rest over ``goal`` (3,) [m, world]."""
    return float(heading(goal)[2] + goal[2])


def target(goal, **changes):
    return dataclasses.replace(APPROACH, **changes).within_reach(torch.tensor(goal))


def test_goals_by_the_cushion_are_clamped_to_where_the_box_clears_it():
    for goal in ([SCENE.half_side, -0.5, 0.0], [0.0, SCENE.half_side, 0.0], [-9.0, -9.0, 0.1], [9.0, 0.0, 0.0]):
        place = target(goal)
        assert place[:2].abs().max() <= APPROACH.half_extent + 1e-6
        assert place[:2].abs().max() + SCENE.box_outer <= SCENE.half_side
    pulled_in = target([APPROACH.half_extent, -APPROACH.half_extent, 0.0], max_radius=0.5)
    assert pulled_in[:2].abs().max() <= APPROACH.half_extent + 1e-6


def test_goals_out_of_reach_are_clamped_along_their_direction_from_the_base():
    for goal in ([0.2, 0.7, 0.0], [-0.1, 0.6, 0.2], [0.0, -0.74, 0.0]):
        way, wanted = target(goal)[:2] - BASE[:2], torch.tensor(goal[:2]) - BASE[:2]
        assert APPROACH.min_radius - 1e-6 <= way.norm() <= APPROACH.max_radius + 1e-6
        torch.testing.assert_close(way / way.norm(), wanted / wanted.norm())


def test_goals_within_reach_are_kept_and_only_those_on_the_table_put_down():
    goal = torch.cat([goals(20), goals(20, height=APPROACH.on_table_below), goals(20, height=0.2)])
    torch.testing.assert_close(APPROACH.within_reach(goal), goal)
    heights = [mouth_height(one) for one in goal]
    assert heights[:40] == pytest.approx([APPROACH.down_height] * 40, abs=1e-6)
    assert heights[40:] == pytest.approx([0.2] * 20, abs=1e-6)


def test_a_box_that_is_upright_and_square_turns_no_more():
    goal = torch.tensor([0.1, -0.3, 0.2])
    assert heading(goal).tolist() == pytest.approx([0.0] * 6, abs=1e-6)
    assert len(APPROACH.twist([torch.tensor(0.5)] * 12, goal.unbind())) == 6


@pytest.mark.parametrize(
    ("end", "expected"), [((0.0, 0.6, 0.2), (0.0, 0.6 * math.pi / 2, 0.0)), ((0.8, 0.0, 0.1), (0.2, 0.0, -0.1))]
)
def test_the_way_sideways_turns_and_reaches_about_the_arms_axis(end, expected):
    start, end = torch.tensor([0.6, 0.0, 0.2]), torch.tensor(end)
    # Every place lies within reach of an arm in the middle of the table.
    middle = dataclasses.replace(APPROACH, base_pos=(0.0, 0.0, 0.0), half_extent=2.0)
    way = heading(end, middle, at=start)[:3]
    torch.testing.assert_close(way, torch.tensor(expected), atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", ["travel_height", "down_height", "drop_distance", "half_extent", "max_radius"])
def test_a_bad_number_is_named(name):
    with pytest.raises(InputError, match=f"{name}.*-0.5"):
        dataclasses.replace(APPROACH, **{name: -0.5})
