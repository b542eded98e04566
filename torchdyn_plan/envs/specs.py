"""What environments declare of their entries, in TorchRL's terms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torchrl.data import Binary, Composite, Unbounded

from torchdyn_plan import keys


def flag_spec(num_envs: int) -> Binary:
    """Of a bool ``(N, 1)``."""
    return Binary(shape=torch.Size((num_envs, 1)), dtype=torch.bool)


def observation_spec(
    num_envs: int,
    *,
    joints: int,
    state_size: int,
    observation_size: int,
    history: int,
    coordinates: int,
    flags: tuple[str, ...],
    static_target: bool,
    measurements: int = 0,
    others: Mapping[str, tuple[tuple[int, ...], torch.dtype]],
) -> Composite:
    """What is observed in ``num_envs`` environments; arguments as of `torchdyn_plan.envs.MovingTargetEnv`.

    ``measurements`` is how many can come at a step, 0 where the target is seen exactly.
    """
    vectors: dict[str, tuple[int, ...]] = {
        keys.TOOL_POS: (coordinates,),
        keys.TARGET_POS: (coordinates,),
        keys.TARGET_HISTORY: (history, coordinates),
        keys.ROBOT_STATE: (state_size,),
        keys.OBSERVATION: (observation_size,),
        keys.ACHIEVED_GOAL: (coordinates,),
        keys.DESIRED_GOAL: (coordinates,),
    }
    if joints:
        vectors |= {keys.JOINT_POS: (joints,), keys.JOINT_VEL: (joints,)}
    if static_target:
        vectors[keys.GOAL] = (coordinates,)
    if measurements:
        vectors[keys.MEASURED_POS], vectors[keys.MEASURED_TIME] = (measurements, coordinates), (measurements,)
        vectors[keys.TRUE_TARGET_POS] = (coordinates,)
    specs: dict[str, Any] = {key: Unbounded(torch.Size((num_envs, *shape))) for key, shape in vectors.items()}
    for key in (keys.HISTORY_LENGTH, keys.EPISODE):
        specs[key] = Unbounded(torch.Size((num_envs,)), dtype=torch.int64)
    specs[keys.STEP_COUNT] = Unbounded(torch.Size((num_envs, 1)), dtype=torch.int64)
    for key, (shape, dtype) in others.items():
        size = torch.Size((num_envs, *shape))
        specs[key] = Binary(shape=size, dtype=dtype) if dtype == torch.bool else Unbounded(size, dtype=dtype)
    for key in flags:
        specs[key] = flag_spec(num_envs)
    return Composite(specs, shape=(num_envs,))
