"""Checkpoint of a fit in one file: tensors in safetensors, scalars and settings as JSON in its metadata."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor, nn

from torchdyn_plan.errors import TrainingError
from torchdyn_plan.files import parse_json, read_tensors, reason, short_path, tensor_bytes, write_tensors
from torchdyn_plan.schemas import check_content

FORMAT = "torchdyn_plan.checkpoint.2"


class About(TypedDict):
    """Metadata of a checkpoint."""

    format: str
    settings: str
    """JSON."""
    progress: str
    """JSON."""
    digest: str
    """Digest of all the rest, to detect damage."""


def save_checkpoint(
    file: Path,
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    generator: torch.Generator,
    *,
    settings: dict[str, Any],
    progress: dict[str, Any],
) -> None:
    """Write everything that the next step depends on to ``file``, atomically.

    Args:
        file: a ``.safetensors`` file.
        network: its parameters and buffers are stored.
        optimiser: its state for each parameter is stored.
        generator: the CPU generator of all later draws.
        settings: JSON values that must be equal when the fit is resumed.
        progress: JSON values that `load_checkpoint` returns.
    """
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{index}.{name}": value for name, value in state.items()}
    write_checkpoint(file, tensors | {"generator": generator.get_state()}, settings=settings, progress=progress)


def write_checkpoint(
    file: Path, tensors: dict[str, Tensor], *, settings: dict[str, Any], progress: dict[str, Any]
) -> None:
    """Write ``tensors``, JSON ``settings`` and JSON ``progress`` to ``file``, atomically."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    about = {"format": FORMAT, "settings": json.dumps(settings), "progress": json.dumps(progress)}
    write_tensors(file, tensors, about | {"digest": _digest(about, tensors)})


def load_checkpoint(
    file: Path,
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    generator: torch.Generator,
    *,
    settings: dict[str, Any],
    schema: Any = dict[str, Any],
) -> Any:
    """Restore network, optimiser and generator from ``file``; returns its progress, checked by ``schema``.

    Raises:
        TrainingError: the file is damaged, or was made with other ``settings``; the first difference is named.
    """
    tensors, progress = read_checkpoint(file, settings=settings, schema=schema)
    try:
        network.load_state_dict(group(tensors, "network"))
        states: dict[int, dict[str, Tensor]] = {}
        for name, value in group(tensors, "optimiser").items():
            index, _, entry = name.partition(".")
            states.setdefault(int(index), {})[entry] = value
        optimiser.load_state_dict({"state": states, "param_groups": optimiser.state_dict()["param_groups"]})
        generator.set_state(tensors["generator"])
    except (KeyError, ValueError, RuntimeError, TypeError) as error:
        raise TrainingError(f"checkpoint {short_path(file)} does not fit this network: {reason(error)}") from error
    return progress


def read_checkpoint(
    file: Path, *, settings: dict[str, Any], schema: Any = dict[str, Any]
) -> tuple[dict[str, Tensor], Any]:
    """Tensors in ``file``, and its progress, checked by ``schema``.

    Raises:
        TrainingError: the file is damaged, or was made with other ``settings``; the first difference is named.
    """
    metadata, tensors = read_tensors(file, _DamagedError)
    if metadata.get("format") != FORMAT:
        raise TrainingError(f"{short_path(file)} is not a checkpoint of this package: {REMEDY}")
    where = short_path(file)
    about: About = check_content(metadata, About, where, _DamagedError)
    if about["digest"] != _digest(metadata, tensors):
        raise _DamagedError(f"{where} differs from what was written")
    try:
        found, progress = parse_json(about["settings"]), parse_json(about["progress"])
    except ValueError as error:
        raise _DamagedError(f"{where} does not tell how it was made: {reason(error)}") from error
    _check_settings(file, settings, check_content(found, dict[str, Any], where, _DamagedError, entry="settings"))
    return tensors, check_content(progress, schema, where, _DamagedError, entry="progress")


REMEDY = "delete it or train without resume"


class _DamagedError(TrainingError):
    """A checkpoint cannot be resumed."""

    def __init__(self, text: str) -> None:
        super().__init__(f"damaged checkpoint: {text}: {REMEDY}")


def _digest(metadata: Mapping[str, str], tensors: Mapping[str, Tensor]) -> str:
    told = hashlib.sha256()
    for name in ("format", "settings", "progress"):
        told.update(f"{name} {metadata[name]} ".encode())
    for name, tensor in sorted(tensors.items()):
        told.update(f"{name} {tensor.dtype} {tuple(tensor.shape)} ".encode())
        told.update(tensor_bytes(tensor))
    return told.hexdigest()


def group(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The ``tensors`` whose names begin with ``prefix`` and a dot, under the rest of their names."""
    return {name.removeprefix(f"{prefix}."): value for name, value in tensors.items() if name.startswith(f"{prefix}.")}


def _check_settings(file: Path, expected: dict[str, Any], found: dict[str, Any]) -> None:
    expected = json.loads(json.dumps(expected))
    for name in sorted(expected.keys() | found.keys()):
        if expected.get(name) != found.get(name):
            raise TrainingError(
                f"checkpoint {short_path(file)} was made with {name} {found.get(name)!r}, not {expected.get(name)!r}: "
                "give the same, another folder, or train without resume"
            )
