"""Where a fit stands, in one file: tensors in safetensors, scalars and settings as JSON in its metadata."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from torchdyn_plan.errors import TrainingError
from torchdyn_plan.files import write_whole

FORMAT = "torchdyn_plan.checkpoint.1"


def save_checkpoint(
    file: Path,
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    generator: torch.Generator,
    *,
    settings: dict[str, Any],
    progress: dict[str, Any],
) -> None:
    """Write everything that the next step depends on to ``file``, whole or not at all.

    Args:
        file: a ``.safetensors`` file.
        network: its parameters and buffers are kept.
        optimiser: its state for each parameter is kept.
        generator: the CPU generator that every later draw comes from.
        settings: what must be the same when the fit goes on; JSON values.
        progress: JSON values that `load_checkpoint` returns.
    """
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{index}.{name}": value for name, value in state.items()}
    write_checkpoint(file, tensors | {"generator": generator.get_state()}, settings=settings, progress=progress)


def write_checkpoint(
    file: Path, tensors: dict[str, Tensor], *, settings: dict[str, Any], progress: dict[str, Any]
) -> None:
    """Write ``tensors``, JSON ``settings`` and JSON ``progress`` to ``file``, whole or not at all."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    metadata = {"format": FORMAT, "settings": json.dumps(settings), "progress": json.dumps(progress)}
    write_whole(file, lambda temporary: save_file(tensors, temporary, metadata))


def load_checkpoint(
    file: Path,
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    generator: torch.Generator,
    *,
    settings: dict[str, Any],
) -> dict[str, Any]:
    """Put network, optimiser and generator back where ``file`` has them; returns its progress.

    Raises:
        TrainingError: the file is damaged, or was made with other ``settings``, of which the first is named.
    """
    tensors, progress = read_checkpoint(file, settings=settings)
    try:
        network.load_state_dict(group(tensors, "network"))
        states: dict[int, dict[str, Tensor]] = {}
        for name, value in group(tensors, "optimiser").items():
            index, _, entry = name.partition(".")
            states.setdefault(int(index), {})[entry] = value
        optimiser.load_state_dict({"state": states, "param_groups": optimiser.state_dict()["param_groups"]})
        generator.set_state(tensors["generator"])
    except (KeyError, ValueError, RuntimeError) as error:
        raise TrainingError(f"checkpoint {str(file)!r} does not fit this network: {error}") from error
    return progress


def read_checkpoint(file: Path, *, settings: dict[str, Any]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and progress in ``file``.

    Raises:
        TrainingError: the file is damaged, or was made with other ``settings``, of which the first is named.
    """
    metadata, tensors = _read(file)
    try:
        found, progress = json.loads(metadata["settings"]), json.loads(metadata["progress"])
    except (KeyError, ValueError) as error:
        raise TrainingError(f"checkpoint {str(file)!r} does not tell how it was made: {error}") from error
    _check_settings(file, settings, found)
    return tensors, progress


def _read(file: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    try:
        with safe_open(file, framework="pt") as content:
            metadata = content.metadata() or {}
            tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise TrainingError(
            f"checkpoint {str(file)!r} is damaged ({error}): delete it or train without resume"
        ) from error
    if metadata.get("format") != FORMAT:
        raise TrainingError(f"{str(file)!r} is no checkpoint of this package: delete it or train without resume")
    return metadata, tensors


def group(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Those of ``tensors`` whose names begin with ``prefix`` and a dot, without them."""
    return {name.removeprefix(f"{prefix}."): value for name, value in tensors.items() if name.startswith(f"{prefix}.")}


def _check_settings(file: Path, expected: dict[str, Any], found: dict[str, Any]) -> None:
    expected = json.loads(json.dumps(expected))
    for name in sorted(expected.keys() | found.keys()):
        if expected.get(name) != found.get(name):
            raise TrainingError(
                f"checkpoint {str(file)!r} was made with {name} {found.get(name)!r}, not {expected.get(name)!r}: "
                "give the same, another folder, or train without resume"
            )
