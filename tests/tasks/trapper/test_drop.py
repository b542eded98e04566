import dataclasses

import pytest
import torch

from torchdyn_plan.envs import TrapperScene
from torchdyn_plan.errors import InputError
from torchdyn_plan.tasks.trapper.wait_and_drop import Drop

DROP = Drop.of(TrapperScene())
START = 0.105
"""Height of the rim where a planner waits."""


def straight(start, velocity, length=DROP.lookahead, dtype=torch.float64):
    """Path (length, 3) of a target on the table."""
    time = torch.arange(length, dtype=dtype)[:, None]
    level = torch.tensor(start, dtype=dtype) + time * torch.tensor(velocity, dtype=dtype)
    return torch.cat([level, torch.full_like(time, DROP.radius)], dim=-1)


def tool(*level, height=START, dtype=torch.float64):
    return torch.tensor([*(level or (0.0, 0.0)), height], dtype=dtype)


def clearance(path, tool_step=(0.0, 0.0, 0.0), height=START):
    return DROP.clearance(path, tool(height=height), torch.tensor(tool_step, dtype=torch.float64))


def scenes(*batch, dtype=torch.float64, seed=0):
    """Paths that cross beneath a tool which moves a little, and the tool."""
    generator = torch.Generator().manual_seed(seed)
    place, velocity, noise = torch.randn(3, *batch, 3, generator=generator, dtype=dtype)
    time = torch.arange(DROP.lookahead, dtype=dtype)[:, None]
    path = 0.05 * place.unsqueeze(-2) + 0.003 * velocity.unsqueeze(-2) * time
    tool_pos = torch.cat([0.01 * noise[..., :2], torch.full_like(noise[..., 2:], START)], dim=-1)
    return path, tool_pos, 0.001 * noise


def test_a_drop_from_rest_gathers_speed_to_its_limit_and_ends_on_the_target():
    heights = DROP.descent(torch.tensor(START), torch.tensor(0.0))
    change = heights.diff()
    assert heights.shape == (25,)
    assert heights[:2].tolist() == pytest.approx([START, START])
    assert change[1:10].tolist() == pytest.approx([-0.0005 * k for k in range(1, 10)], abs=1e-7)
    assert change.min().item() == pytest.approx(-0.0045, abs=1e-7)
    assert (change <= 0).all()
    assert heights[-1] == heights.min() == torch.tensor(DROP.radius)


def test_a_drop_goes_on_at_the_speed_that_the_tool_has():
    speeds = torch.tensor([0.002, 0.0, -0.003, -0.1])
    heights = DROP.descent(torch.full((4,), 0.15), speeds)
    assert heights[:, 1].tolist() == pytest.approx([0.152, 0.15, 0.147, 0.1455])
    assert (heights.diff(dim=0) <= 0).all()
    assert (heights.diff(dim=-1) >= -0.0045 - 1e-7).all()


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.01, -0.02), (-0.02, 0.01)])
def test_a_target_at_rest_beneath_the_box_is_enclosed_by_its_gap_to_the_nearest_wall(offset):
    expected = 0.065 - 0.042 - max(map(abs, offset))
    result = clearance(straight(offset, (0.0, 0.0)))
    assert result.tolist() == pytest.approx([expected - 0.002 * k for k in range(8)])


@pytest.mark.parametrize("start", [(0.12, 0.0), (0.0, -0.12), (-0.5, 0.5)])
@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.0, 0.001), (-0.001, 0.0), (0.001, 0.001)])
def test_a_target_that_stays_outside_is_not_enclosed(start, velocity):
    assert (clearance(straight(start, velocity)) < 0).all()


def test_a_target_that_passes_beside_or_is_through_before_the_rim_is_down_is_not_enclosed():
    assert (clearance(straight((-0.1, 0.1), (0.006, 0.0))) < 0).all()
    assert (clearance(straight((0.0, 0.0), (0.02, 0.0))) < 0).all()


@pytest.mark.parametrize("start", [(0.0, 0.0), (-1.0, 0.0)])
def test_a_rim_too_high_to_come_down_in_time_encloses_nothing(start):
    assert (clearance(straight(start, (0.001, 0.0)), height=0.3) < 0).all()


def by_hand(path, tool_pos, tool_step, start):
    """Clearance of a drop that begins in ``start`` steps, one step and one axis at a time."""
    rim, speed, steps = float(tool_pos[2]), float(tool_step[2]), []
    for k in range(DROP.steps + 1):
        if k > 0:
            rim = max(rim + max(speed - 0.0005 * (k - 1), -0.0045), 0.042)
        glide = 2.0 * (1 - 2.718281828459045 ** (-(start + k) / 2.0))
        steps.append((rim, [float(path[start + k, i] - tool_pos[i] - tool_step[i] * glide) for i in (0, 1)]))
    heading = [1 if steps[-1][1][i] > steps[0][1][i] else -1 for i in (0, 1)]
    best = 1.0
    for height, offset in steps:
        above = min(max(height - 0.042, 0.0), 0.042)
        reach = (0.042**2 - above**2) ** 0.5
        along = [h * o for h, o in zip(heading, offset, strict=True)]
        if max(along) > 0.065 - reach:
            return min(best, 0.5 * (0.070 - height), 0.065) - 0.002 * start
        if height < 0.0835:
            best = min(best, min(along) + 0.065 - reach)
    return min(best, 0.065) - 0.002 * start


def test_agrees_with_a_loop_over_the_steps():
    path, tool_pos, tool_step = scenes(60)
    result = DROP.clearance(path, tool_pos, tool_step)
    expected = [[by_hand(*row, k) for k in range(8)] for row in zip(path, tool_pos, tool_step, strict=True)]
    assert torch.allclose(result, torch.tensor(expected, dtype=torch.float64), atol=1e-9)
    assert 5 < (result[:, 0] > 0).sum() < 55


def test_a_slow_target_is_waited_for_until_it_is_well_inside():
    path = straight((-0.1, 0.0), (0.004, 0.0), length=80)
    begun = [int(clearance(path[t : t + 32]).argmax()) for t in range(48)]
    now = [float(clearance(path[t : t + 32])[0]) for t in range(48)]
    first = next(t for t in range(48) if begun[t] == 0 and now[t] > 0)
    assert first == max(range(48), key=lambda t: by_hand(path, tool(), torch.zeros(3), t))
    assert begun[first - 4 : first + 1] == [4, 3, 2, 1, 0]
    assert now[first] > next(value for value in now if value > 0) + 0.01
    # When the rim is at the height of the ball's top, the ball is within the box on all sides.
    down = next(k for k, height in enumerate(DROP.descent(torch.tensor(START), torch.tensor(0.0))) if height < 0.0835)
    assert abs(float(path[first + down, 0])) < 0.065


@pytest.mark.parametrize("mirror", [(-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (-1.0, -1.0, 1.0)])
def test_a_mirrored_scene_is_judged_alike(mirror):
    path, tool_pos, tool_step = scenes(40)
    path[:10], tool_step[:10] = path[:10, :1].clone(), 0.0
    mirror = torch.tensor(mirror, dtype=path.dtype)
    mirrored = DROP.clearance(path * mirror, tool_pos * mirror, tool_step * mirror)
    assert torch.equal(DROP.clearance(path, tool_pos, tool_step), mirrored)


def test_turning_x_into_y_changes_nothing():
    swapped = [value[..., [1, 0, 2]] for value in scenes(40)]
    assert torch.equal(DROP.clearance(*scenes(40)), DROP.clearance(*swapped))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_a_batch_is_a_loop_over_its_rows(batch, dtype):
    values = scenes(*batch, dtype=dtype)
    result = DROP.clearance(*values)
    assert (result.shape, result.dtype) == ((*batch, 8), dtype)
    path, tool_pos, tool_step = (value.reshape(-1, *value.shape[len(batch) :]) for value in values)
    for row in range(len(path)):
        assert torch.equal(result.reshape(-1, 8)[row], DROP.clearance(path[row], tool_pos[row], tool_step[row]))


def test_a_tool_that_stops_at_once_does_not_glide():
    path, tool_pos, tool_step = scenes(5)
    at_rest = torch.cat([torch.zeros_like(tool_step[:, :2]), tool_step[:, 2:]], dim=-1)
    drop = dataclasses.replace(DROP, glide=0.0)
    assert torch.equal(drop.clearance(path, tool_pos, tool_step), drop.clearance(path, tool_pos, at_rest))


BAD = [
    (name, -0.5)
    for name in ("radius", "half_width", "speed", "acceleration", "catch_height", "glide", "min_clearance_gain")
]
BAD += [("steps", 0), ("steps", 2.5), ("choices", 0), ("speed", float("nan"))]


@pytest.mark.parametrize(("name", "value"), BAD)
def test_a_bad_setting_is_named(name, value):
    with pytest.raises(InputError, match=f"{name}.*{value}"):
        dataclasses.replace(DROP, **{name: value})


def test_sizes_follow_the_scene():
    assert Drop.of(TrapperScene()) == Drop(radius=0.042, half_width=0.065)
    other = Drop.of(TrapperScene(ball_radius=0.03, box_half_width=0.05))
    assert (other.radius, other.half_width) == (0.03, 0.05)
    assert dataclasses.replace(other, radius=0.042, half_width=0.065) == DROP
