"""Arms of many joints: built at once, in little memory, and right."""

import itertools
import random
import subprocess
import sys
from pathlib import Path
from time import process_time

import pytest
import torch

from tests.kinematics.arms import ARMS, Row, configurations, product_of_transforms, urdf
from torchdyn_plan.errors import InputError
from torchdyn_plan.kinematics import Arm
from torchdyn_plan.kinematics.forms import MOST_SINES, best_cuts, transform_form
from torchdyn_plan.kinematics.joint import merge_fixed
from torchdyn_plan.kinematics.trigonometric import sine_counts, trigonometric_form
from torchdyn_plan.kinematics.urdf import joints_of_urdf

ROOT = Path(__file__).parents[2]
TOOL = Row((0, 0, 0.1), kind="fixed")


def general(count):
    numbers = random.Random(0)

    def vector(size):
        return tuple(numbers.uniform(-size, size) for _ in range(3))

    return [*(Row(vector(0.2), vector(1.0), axis=vector(1.0)) for _ in range(count)), TOOL]


def like_a_ur(count):
    return [*itertools.islice(itertools.cycle(ARMS["ur5"][:6]), count), TOOL]


def snake(count):
    return [*(Row((0.1, 0, 0), axis=(0, 0, 1) if index % 2 else (0, 1, 0)) for index in range(count)), TOOL]


def planar(count):
    return [*(Row((0.1, 0, 0)) for _ in range(count)), TOOL]


def with_slides(count):
    return [*(Row((0.1, 0, 0), kind=("revolute", "prismatic")[index % 3 == 1]) for index in range(count)), TOOL]


def flat_before_a_slide(count):
    return [*planar(count - 1)[:-1], Row((0.1, 0, 0), kind="prismatic"), TOOL]


SHAPES = (general, like_a_ur, snake, planar, with_slides, flat_before_a_slide)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("form", ["auto", "transforms"])
def test_forty_joints_are_built_at_once_in_little_memory_and_right(shape, form):
    rows = shape(40)
    # The first arm of a process imports the parser.
    Arm.from_urdf(urdf(shape(2)), tip="tool")
    text, started = urdf(rows), process_time()
    arm = Arm.from_urdf(text, tip="tool", form=form, dtype=torch.float64)
    # A quarter of a second on an idle core; work that grows exponentially would not be done in this time.
    assert process_time() - started < 5.0
    q = configurations(3, 40)
    pose, jacobian = arm.pose_and_jacobian(q)
    torch.testing.assert_close(pose, product_of_transforms(rows, q), atol=1e-9, rtol=0)
    slope = torch.func.jacfwd(lambda q: arm(q)[:3, 3])(q[0])
    torch.testing.assert_close(jacobian[0, :3], slope, atol=1e-9, rtol=0)
    # What the arm keeps: the products' constants are by far the most.
    assert sum(value.numel() * value.element_size() for value in arm.buffers()) < 20e6


@pytest.mark.parametrize("count", [12, 13, 14, 41, 70])
def test_any_number_of_joints_is_right(count):
    rows = general(count)
    q = configurations(2, count)
    arm = Arm.from_urdf(urdf(rows), tip="tool", dtype=torch.float64)
    torch.testing.assert_close(arm(q), product_of_transforms(rows, q), atol=1e-9, rtol=0)


def test_one_product_of_too_many_sines_is_refused_at_once():
    Arm.from_urdf(urdf(general(7)), tip="tool", form="sines")
    for count in (9, 14, 40):
        started = process_time()
        with pytest.raises(InputError, match=r"more than 6561 terms up to joint 'joint8': too many for one product"):
            Arm.from_urdf(urdf(general(count)), tip="tool", form="sines")
        assert process_time() - started < 5.0


def all_cuts(count):
    for parts in range(min(2, count), count + 1):
        for inner in itertools.combinations(range(1, count), parts - 1):
            yield (0, *inner, count)


def chosen_out_of_all(count, sines, most):
    """The rule of `best_cuts`, by looking at all cuts: fewest parts first, the first with the fewest sines."""
    best, fewest = None, None
    for cuts in all_cuts(count):
        parts = list(itertools.pairwise(cuts))
        if not all(part in sines for part in parts):
            continue
        if best is not None and len(cuts) > len(best) and fewest <= most:
            break
        total = sum(sines[part] for part in parts)
        if best is None or total < fewest:
            best, fewest = cuts, total
    return best


@pytest.mark.parametrize("seed", range(40))
def test_cuts_are_those_found_by_looking_at_all(seed):
    numbers = random.Random(seed)
    count = numbers.randint(1, 8)
    parts = [(start, stop) for start in range(count) for stop in range(start + 1, count + 1)]
    kept = [part for part in parts if part[1] == part[0] + 1 or numbers.random() < 0.8]
    sines = {part: numbers.randint(1, 6) * (part[1] - part[0]) ** numbers.choice([1, 2]) for part in kept}
    most = numbers.choice([10, 30, 100])
    assert best_cuts(count, sines, most) == chosen_out_of_all(count, sines, most)


@pytest.mark.parametrize("shape", SHAPES)
def test_sines_are_counted_right(shape):
    moving, tool = merge_fixed(joints_of_urdf(urdf(shape(6)), base=None, tip="tool"))
    counts = []
    for negligible in (1e-12, -1.0):
        for start in range(6):
            part = moving[start:]
            try:
                for length, count in enumerate(
                    sine_counts(part, itertools.repeat(tool), negligible=negligible, most=6561), 1
                ):
                    counts.append(count)
                    assert count == len(trigonometric_form(part[:length], tool, negligible=negligible).phases)
            except InputError:
                assert shape in (with_slides, flat_before_a_slide)
    assert max(counts) > 1


@pytest.mark.parametrize("name", ["ur5", "panda", "scara", "gantry", "iiwa"])
def test_arms_are_cut_as_by_looking_at_all_cuts(name):
    moving, tool = merge_fixed(joints_of_urdf(urdf(ARMS[name]), base=None, tip="tool"))
    sines = {}
    for start, stop in itertools.combinations(range(len(moving) + 1), 2):
        try:
            last = tool if stop == len(moving) else torch.eye(4, dtype=torch.float64)
            sines[start, stop] = len(trigonometric_form(moving[start:stop], last).phases)
        except InputError:
            continue
    cuts = chosen_out_of_all(len(moving), sines, MOST_SINES)
    assert transform_form(moving, tool).counts == tuple(stop - start for start, stop in itertools.pairwise(cuts))


MEMORY = """
import resource
from tests.kinematics.arms import urdf
from tests.kinematics.test_long_chains import like_a_ur
from torchdyn_plan.kinematics import Arm

Arm.from_urdf(urdf(like_a_ur(7)), tip="tool")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
Arm.from_urdf(urdf(like_a_ur(40)), tip="tool")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def test_memory_of_building_stays_small():
    # In a process of its own, whose peak nothing else has raised before.
    run = subprocess.run([sys.executable, "-c", MEMORY], cwd=ROOT, capture_output=True, text=True, check=True)
    assert int(run.stdout) < 100 * 1024
