import dataclasses
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from torchdyn_plan.envs import TrapperScene, TrapperSimulation
from torchdyn_plan.envs.trapper.arm_runner import TrapperArmRunner
from torchdyn_plan.envs.trapper.starts import draw_starts
from torchdyn_plan.tasks.trapper import solvable as solvability
from torchdyn_plan.tasks.trapper.solvable import NEVER, ArrivalMap, arrival_map, is_solvable, record_path
from torchdyn_plan.tasks.trapper.task import ik_planner

SCENE = TrapperScene()
MAP = ArrivalMap(torch.arange(9).view(3, 3), 1.0)


@pytest.mark.parametrize("friction", [0.0, 5.0])
def test_a_recorded_path_is_the_balls_in_the_full_scene_with_the_arm_held_still(friction):
    place, velocity = draw_starts(SCENE, torch.arange(16), velocity=4.0, split="dev", seed=0)
    path = record_path(SCENE, place, velocity, steps=300, friction=friction, num_threads=1)
    full = TrapperSimulation(16, SCENE, friction=friction, num_threads=1)
    full.reset(torch.arange(16), place, velocity)
    assert path.shape == (16, 301, 3)
    for step in range(301):
        torch.testing.assert_close(path[:, step].double(), full.ball_pos, atol=1e-6, rtol=0)
        full.step(torch.zeros(16, 6))
    assert (path[:, -1] - path[:, 0]).norm(dim=-1).min() > 0.01


def test_the_nearest_point_of_a_map_answers_and_never_outside():
    place = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [0.4, -0.4], [0.6, 0.0], [0.4, 0.6]])
    assert MAP.at(place).tolist() == [0, 2, 6, 4, 7, 5]
    outside = torch.tensor([[1.6, 0.0, 0.0], [0.0, -1.6, 0.0], [9.0, 9.0, 0.0]])
    assert MAP.at(outside).tolist() == [NEVER] * 3
    assert MAP.at(place.view(2, 3, 2)).tolist() == [[0, 2, 6], [4, 7, 5]]


def passing(step, height=SCENE.ball_radius):
    """A ball that is at the map's point of 5 steps at ``step`` alone, else where the arm never arrives, (10, 3)."""
    path = torch.tensor([5.0, 5.0, SCENE.ball_radius]).repeat(10, 1)
    path[step] = torch.tensor([0.0, 1.0, height])
    return path


@pytest.mark.parametrize(("step", "solvable"), [(4, False), (5, True), (6, True), (0, False), (9, True)])
def test_a_ball_can_be_met_where_it_passes_no_sooner_than_the_arm(step, solvable):
    assert bool(is_solvable(MAP, SCENE, passing(step))) is solvable


def test_a_swallowed_ball_is_not_met():
    deep = -SCENE.ball_radius - 1e-4
    paths = torch.stack([passing(7), passing(7, deep), passing(4), passing(7, deep)])
    paths[3, 9] = paths[0, 7]
    assert is_solvable(MAP, SCENE, paths).tolist() == [True, False, False, True]
    assert is_solvable(MAP, SCENE, paths.view(2, 2, 10, 3)).tolist() == [[True, False], [False, True]]


def test_an_arm_that_never_arrives_solves_nothing():
    never = ArrivalMap(torch.full((3, 3), NEVER), 1.0)
    assert not is_solvable(never, SCENE, torch.zeros(4, 900, 3) + SCENE.ball_radius).any()


def test_measured_arrivals_are_those_of_single_runs(monkeypatch):
    monkeypatch.setattr(solvability, "LONGEST", 200)
    arrivals = solvability.measure_arrivals(ik_planner(chunk=32), SCENE, spacing=0.2, num_threads=1)
    count = len(arrivals.steps)
    line = torch.linspace(-SCENE.half_side, SCENE.half_side, count)
    assert line.diff().max() <= 0.2
    assert arrivals.steps.shape == (count, count)
    corners = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]) * SCENE.half_side
    assert arrivals.at(corners).tolist() == [NEVER] * 4
    home = TrapperArmRunner(ik_planner(), 1, num_threads=1).tool_pos
    assert arrivals.at(home).item() < 60
    for i, j in ((4, 2), (5, 3), (6, 1)):
        goal = torch.tensor([[line[i], line[j], SCENE.ball_radius]])
        assert arrivals.steps[i, j] == arrivals.at(goal).item() == steps_to(goal)
    # A transposed map would have the arm reach as far to its side as ahead.
    assert arrivals.steps[4, 1] < NEVER == arrivals.steps[1, 4]


def steps_to(goal):
    arm = TrapperArmRunner(ik_planner(chunk=32), 1, num_threads=1)
    for step in range(200):
        if bool(arm.is_reached(goal)):
            return step
        arm.step(goal)
    return NEVER


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Folders for shipped and cached maps, and the list of scenes that were measured."""
    shipped, measured = tmp_path / "shipped", []

    def measure(planner, scene, *, num_threads=0):
        measured.append(scene.digest())
        return ArrivalMap(torch.full((3, 3), len(measured)), scene.half_side)

    monkeypatch.setattr(solvability, "SHIPPED", shipped)
    monkeypatch.setattr(solvability, "measure_arrivals", measure)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return shipped, tmp_path / "cache" / "torchdyn_plan", measured


def lookup(scene=SCENE, static="ik"):
    arrivals = arrival_map(static, ik_planner(), scene)
    assert arrivals.half_side == scene.half_side
    assert arrivals.steps.dtype == torch.int64
    return int(arrivals.steps[0, 0])


def test_a_map_is_measured_once_for_each_scene_and_planner(folders):
    other = dataclasses.replace(SCENE, box_mass=0.3)
    assert [lookup(), lookup(), lookup(other), lookup(other), lookup(static="other"), lookup()] == [1, 1, 2, 2, 3, 1]
    assert folders[2] == [SCENE.digest(), other.digest(), SCENE.digest()]


@pytest.mark.parametrize("damage", ["cut", "empty", "foreign", "flat", "oblong", "fractions", "beyond", "negative"])
def test_a_damaged_map_is_measured_again_and_replaced(folders, damage):
    lookup()
    (file,) = folders[1].iterdir()
    content = {
        "foreign": {"other": torch.zeros(3, 3, dtype=torch.int32)},
        "flat": {"steps": torch.zeros(9).int()},
        "oblong": {"steps": torch.zeros(3, 4).int()},
        "fractions": {"steps": torch.zeros(3, 3)},
        "beyond": {"steps": torch.full((3, 3), 501).int()},
        "negative": {"steps": torch.full((3, 3), -1).int()},
    }
    if damage in content:
        save_file(content[damage], file)
    else:
        file.write_bytes(file.read_bytes()[:-5] if damage == "cut" else b"")
    assert lookup() == 2
    assert (load_file(file)["steps"] == 2).all()


def test_a_map_that_cannot_be_cached_is_used_all_the_same(folders, monkeypatch):
    folders[1].parent.write_text("in the way of the folder")
    assert [lookup(), lookup()] == [1, 2]
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: Path("/proc/nowhere"))
    assert lookup() == 3


def test_a_shipped_map_comes_first(folders):
    lookup()
    name = f"arrivals-ik-{SCENE.digest()}.safetensors"
    solvability.save_arrivals(ArrivalMap(torch.full((3, 3), 77), SCENE.half_side), folders[0] / name)
    assert lookup() == 77
    assert len(folders[2]) == 1
