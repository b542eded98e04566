"""Collected data in a folder: shards, and the descriptions that they are checked against."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

from torch import Tensor

from torchdyn_plan.errors import InputError
from torchdyn_plan.files import files_in, read_json, read_metadata, read_tensors, short_path, tensor_bytes
from torchdyn_plan.schemas import Count, Positive, check_content

SHARD = {"paths": 1024, "arrivals": 2048, "captures": 1024}
"""Episodes in a shard of paths or captures, and sequences of runs in a shard of arrivals."""


class Arguments(TypedDict):
    """Arguments of a collection that are read back."""

    episodes: Positive
    seed: Count
    num_envs: Positive
    static: str
    """Static planner of the arrivals or captures; unused for paths."""


class Description(TypedDict):
    """Content of a collection's description that is read back."""

    arguments: Arguments
    scene: str


def shard_path(folder: Path, stem: str, seed: int, index: int) -> Path:
    """File of the shard ``index`` of series ``seed`` of the data called ``stem``."""
    return folder / f"{stem}-{seed}-{index:03d}.safetensors"


def shard_sizes(stem: str, episodes: int) -> list[int]:
    """Number of episodes in each shard, for ``episodes`` in total."""
    size = SHARD[stem]
    return [min(size, episodes - first) for first in range(0, episodes, size)]


def surplus_shards(folder: Path, stem: str, seed: int, count: int) -> list[Path]:
    """Shards of series ``seed`` in ``folder`` beyond its first ``count``."""
    known = {shard_path(folder, stem, seed, index) for index in range(count)}
    return sorted(set(files_in(folder, f"{stem}-{seed}-*.safetensors")) - known)


def read_description(data: Path, stem: str, *, scene: str) -> dict[str, Any]:
    """Description of the ``stem-*.safetensors`` in ``data``.

    It has ``data``, the arguments of each collection; ``scene``; and but for paths ``static`` and, for a policy with
    given weights, their digest as ``weights``.

    Args:
        data: folder of `torchdyn_plan.training.collect`.
        stem: ``paths``, ``arrivals`` or ``captures``.
        scene: digest of the scene that the data must come from.

    Raises:
        InputError: there is no description, it is broken, is of another scene, descriptions are of different static
            planners, or the shards do not match their description.
    """
    data = Path(data)
    files = files_in(data, f"{stem}-*.json")
    if not files:
        raise InputError(f"no {stem}-*.json in {short_path(data)}: its collection did not finish")
    arguments: list[dict[str, Any]] = []
    described: dict[Path, dict[str, str]] = {}
    for file in files:
        content = read_json(file)
        about: Description = check_content(content, Description, f"{short_path(file)} is not a description of data")
        if about["scene"] != scene:
            raise InputError(
                f"{short_path(file)} is of scene {about['scene']}, but the scene is {scene}: collect the data again"
            )
        series = f"{stem}-{about['arguments']['seed']}.json"
        if file.name != series:
            raise InputError(f"{short_path(file)} describes another series, whose description is {series}: delete it")
        described |= _check_shards(data, stem, about)
        arguments.append(content["arguments"])
    stray = sorted(set(files_in(data, f"{stem}-*.safetensors")) - described.keys())
    if stray:
        raise InputError(
            f"{short_path(stray[0])} belongs to no description in its folder: its collection did not finish, or was "
            "of more episodes: collect again, or delete it"
        )
    _check_alike(described)
    return {"data": arguments, "scene": scene} | driver_of(next(iter(described.values())))


def read_shards(folder: Path, stem: str, names: Sequence[str]) -> list[dict[str, Tensor]]:
    """Tensors of every ``stem-*.safetensors`` in ``folder``; raises `InputError` naming what is missing or broken."""
    files = files_in(Path(folder), f"{stem}-*.safetensors")
    if not files:
        raise InputError(f"no {stem}-*.safetensors in {short_path(Path(folder))}")
    shards = []
    for file in files:
        made, shard = read_tensors(file, InputError)
        missing = [name for name in names if name not in shard]
        if missing:
            raise InputError(f"{short_path(file)} lacks {', '.join(missing)}")
        if made.get("content", content := content_digest(shard)) != content:
            raise InputError(f"{short_path(file)} is damaged: it differs from what was written")
        if "length" in names and made.get("episodes", str(len(shard["length"]))) != str(len(shard["length"])):
            raise InputError(f"{short_path(file)} says {made['episodes']} episodes and has {len(shard['length'])}")
        shards.append(shard)
    return shards


def content_digest(tensors: Mapping[str, Tensor]) -> str:
    """A short digest of a shard's content."""
    told = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        told.update(f"{name} {tensor.dtype} {tuple(tensor.shape)} ".encode())
        told.update(tensor_bytes(tensor))
    return told.hexdigest()[:16]


def check_made(path: Path, made: dict[str, str]) -> list[str]:
    """Differences between the metadata of the shard at ``path`` and ``made``; the metadata must be complete.

    Raises:
        InputError: the shard is damaged, or differs in more than the number of its ``episodes``.
    """
    there = _read_made(path)
    told = {**made, **dict.fromkeys(_DECISIVE & there.keys())}
    differing = [name for name in told if there.get(name) != made.get(name)]
    for name in differing:
        if name != "episodes":
            raise InputError(
                f"{short_path(path)} is of another collection: {name} is {there.get(name)} there, {made.get(name)} here"
            )
    return differing


_DECISIVE = {"scene", "num_envs", "episodes", "static", "weights"}
"""Metadata that, together with its name, determines a shard's numbers."""


def _read_made(path: Path) -> dict[str, str]:
    """Metadata of the shard at ``path``; raises `InputError` if it names another shard."""
    there = read_metadata(path, InputError)
    if there.get("shard", path.stem) != path.stem:
        raise InputError(f"{short_path(path)} is the shard {there['shard']} under another name: delete it")
    return there


def _check_shards(data: Path, stem: str, about: Description) -> dict[Path, dict[str, str]]:
    """Shards of a description, and their metadata; raises `InputError` if one is missing or different."""
    asked = about["arguments"]
    found: dict[Path, dict[str, str]] = {}
    for index, episodes in enumerate(shard_sizes(stem, asked["episodes"])):
        path = shard_path(data, stem, asked["seed"], index)
        made = {"scene": about["scene"], "num_envs": str(asked["num_envs"]), "episodes": str(episodes)}
        made |= {} if stem == "paths" else {"static": asked["static"]}
        there = _read_made(path)
        for name, value in made.items():
            if there.get(name) != value:
                raise InputError(
                    f"{short_path(path)} is not what its description says: {name} is {there.get(name)} there, {value} "
                    "in the description: collect again"
                )
        found[path] = there
    return found


def _check_alike(described: dict[Path, dict[str, str]]) -> None:
    """Raise `InputError` if the shards are of several static planners."""
    first = next(iter(described.values()))
    for path, there in described.items():
        if driver_of(there) != driver_of(first):
            raise InputError(
                f"{short_path(path)} has data of {_named(there)}, others in its folder of {_named(first)}: a "
                "network is of one static planner, whose data has a folder of its own"
            )


def driver_of(made: Mapping[str, Any]) -> dict[str, Any]:
    """Static planner of a shard or of a description, from what it says of itself; empty for paths."""
    return {name: made[name] for name in ("static", "weights") if name in made}


def _named(made: dict[str, str]) -> str:
    return " with weights ".join(driver_of(made).values())
