"""Small data of known origin: mirrors at the cushions, and a robot that goes straight."""

import json

import torch
from safetensors.torch import save_file

from torchdyn_plan.envs.trapper.scene import TrapperScene
from torchdyn_plan.nets.reflection import reflect

EXTENT = 0.7
STEPS = 420


def rolling_line(episodes=12, steps=STEPS, seed=0):
    """Unreflected lines ``(E, T, 3)`` at constant velocity, no sample near a cushion's edge by accident."""
    draw = torch.Generator().manual_seed(seed)
    start = torch.rand(episodes, 1, 3, generator=draw, dtype=torch.float64) - 0.5
    step = (0.03 * torch.rand(episodes, 1, 3, generator=draw, dtype=torch.float64) - 0.015) * torch.tensor([1, 1, 0.0])
    line = start + step * torch.arange(steps, dtype=torch.float64).unsqueeze(-1)
    line[..., 2] = 0.037
    return line


def write_paths(folder, *, lost=(1, 4), digest=None, **settings):
    """Shard and description of `rolling_line`, reflected; episodes ``lost`` end so at sample 200."""
    line = rolling_line(**settings)
    path = torch.cat([reflect(line[..., :2], EXTENT), line[..., 2:]], dim=-1).float()
    parts = []
    for number, positions in enumerate(path):
        parts.append(positions[:201].clone() if number in lost else positions)
        if number in lost:
            parts[-1][-1, 2] = -0.05
    length = torch.tensor([len(part) for part in parts])
    pocketed = torch.zeros(len(parts), dtype=torch.bool)
    pocketed[list(lost)] = True
    tensors = {
        "positions": torch.cat(parts),
        "length": length,
        "start": length.cumsum(0) - length,
        "pocketed": pocketed,
    }
    save_file(tensors, folder / "paths-0-000.safetensors", made(len(parts), digest))
    describe(folder, "paths", digest, len(parts))
    return tensors


def write_arrivals(folder, *, runs=40, digest=None):
    """Arrivals of a tool that goes a centimetre a step, never beyond 0.9 m: five samples a run."""
    draw = torch.Generator().manual_seed(0)
    state = torch.rand(5 * runs, 15, generator=draw) - 0.5
    goal = 2 * torch.rand(5 * runs, 3, generator=draw) - 1
    distance = (goal - state[:, 12:]).norm(dim=-1)
    arrival = torch.where(distance > 0.9, -1, (distance / 0.01).round().long())
    run = torch.arange(runs).repeat_interleave(5)
    tensors = {"robot_state": state, "goal": goal, "arrival": arrival, "nearest": arrival.clamp_min(0), "run": run}
    save_file(tensors, folder / "arrivals-0-000.safetensors", made(12, digest) | {"static": "ik"})
    describe(folder, "arrivals", digest)
    return tensors


def made(episodes, digest=None):
    """What a shard says of itself."""
    return {"scene": digest or TrapperScene().digest(), "num_envs": "4", "episodes": str(episodes)}


def describe(folder, stem, digest=None, episodes=12):
    arguments = {"episodes": episodes, "seed": 0, "num_envs": 4, "static": "ik"}
    about = {"arguments": arguments, "scene": digest or TrapperScene().digest(), "versions": {}}
    (folder / f"{stem}-0.json").write_text(json.dumps(about))
