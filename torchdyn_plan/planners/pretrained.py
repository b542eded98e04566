"""Saving and loading whole planners: parts as JSON, networks as safetensors, a model card; nothing is pickled."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
import math
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, Self, TypedDict, runtime_checkable

import torch
from torch import Tensor

from torchdyn_plan.checks import check_choice
from torchdyn_plan.errors import InputError, WeightsError
from torchdyn_plan.files import (
    check_writable_folder,
    is_file,
    is_folder,
    no_empty_folders,
    read_json,
    short_path,
    tensor_bytes,
    write_json,
    write_whole,
)
from torchdyn_plan.nets.pretrained import SHIPPED, Pretrained
from torchdyn_plan.schemas import check_content
from torchdyn_plan.versions import library_versions

FORMAT = "torchdyn_plan.planner.1"
FILE = "planner.json"
OWN = "torchdyn_plan."
"""Modules with this prefix may be imported for a file; other classes only if the program has imported their module."""


@runtime_checkable
class HasSettings(Protocol):
    """A part that gives its own constructor arguments; those of a frozen dataclass are its fields."""

    def part_settings(self) -> dict[str, Any]:
        """Names and values of the arguments of its constructor."""
        ...


class PretrainedPlanner:
    """Adds `save_pretrained` and `from_pretrained` to a planner made of parts."""

    def prepare(self) -> Self:
        """Called once all parts are loaded and frozen; does nothing by default. Returns itself."""
        return self

    def save_pretrained(self, folder: str | Path) -> Path:
        """Write the planner into ``folder``: ``planner.json``, a ``.safetensors`` for each network, and a card.

        A part that is a plain function cannot be saved: it must be passed again when the planner is loaded.

        Returns:
            The JSON file. Raises `OutputError` if it cannot be written.
        """
        folder, written = Path(folder), {}
        with no_empty_folders(folder):
            content = describe_planner(self, lambda network: _save(network, check_writable_folder(folder), written))
            write_json(folder / FILE, content)
            write_whole(folder / "planner.md", lambda file: file.write_text(_card(content), encoding="utf-8"))
        return folder / FILE

    @classmethod
    def from_pretrained(
        cls, name_or_folder: str | Path, *, device: torch.device | str | None = None, **parts: Any
    ) -> Self:
        """Load a shipped planner by name (``"TASK-STATIC"`` for the paper's), or one saved by `save_pretrained`.

        Args:
            name_or_folder: the name or the folder.
            device: where its networks go.
            parts: parts that replace those in the file, by the names of the constructor's arguments.

        Raises:
            InputError: there is no such planner (the message lists the shipped ones), or a given part is invalid.
            WeightsError: the file is damaged, holds another planner, or lacks a part that was not given.
        """
        file = _find(name_or_folder)
        content = _read(file)
        if content.get("class") != _path_of(cls):
            raise WeightsError(f"{str(file)!r} holds {content.get('class')}, expected {_path_of(cls)}")
        described = content["parts"]
        for name in parts:
            check_choice("part", name, described)
        load = _Loader(file)
        made = {name: parts[name] if name in parts else load.part(name, value) for name, value in described.items()}
        try:
            planner: Any = cls(**made)
            # A part missing from the file would silently become the default.
            missing = sorted(planner.part_settings().keys() - made.keys())
            if missing:
                raise WeightsError(f"{str(file)!r} lacks {', '.join(missing)}")
            return _ready(planner.to(device), parts)
        except (TypeError, ValueError, AttributeError, RuntimeError) as error:
            if isinstance(error, WeightsError) or (isinstance(error, InputError) and parts):
                raise
            raise WeightsError(f"{str(file)!r} describes no planner that can be made: {error}") from error


def _save(network: Pretrained, folder: Path, written: dict[int, str]) -> str:
    """Write ``network`` into ``folder`` unless it was already ``written``; returns its file name."""
    if id(network) not in written:
        count = sum(name.startswith(network.kind) for name in written.values())
        name = f"{network.kind}{count + 1 if count else ''}.safetensors"
        network.save_pretrained(folder / name)
        written[id(network)] = name
    return written[id(network)]


def shipped_planners() -> list[str]:
    """Names of the planners that ship."""
    return sorted(file.stem.removeprefix("planner-") for file in SHIPPED.glob("planner-*.json"))


def _ready(planner: Any, given: Mapping[str, Any]) -> Any:
    """``planner`` frozen and in evaluation mode, except for its parts that were ``given``."""
    planner.training = False
    for name, module in planner.named_children():
        if name not in given:
            module.eval().requires_grad_(False)
    return planner.prepare()


def describe_planner(planner: Any, save: Callable[[Pretrained], str]) -> dict[str, Any]:
    """``planner`` as JSON; ``save`` stores a network and returns its file name."""
    parts = {name: _describe(value, save) for name, value in planner.part_settings().items()}
    return {"format": FORMAT, "class": _path_of(type(planner)), "parts": parts}


def planner_digest(planner: Any) -> str | None:
    """A short digest of a planner's parts, settings and tensors; None for a bare function."""
    if not isinstance(planner, torch.nn.Module):
        return None
    told = hashlib.sha256()
    for module in planner.modules():
        settings = (
            describe_planner(module, lambda network: repr(network.config)) if hasattr(module, "part_settings") else None
        )
        told.update(f"{_path_of(type(module))} {json.dumps(settings, sort_keys=True)}".encode())
    for name, tensor in planner.state_dict().items():
        told.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        told.update(tensor_bytes(tensor))
    return told.hexdigest()[:16]


def _describe(value: Any, save: Callable[[Pretrained], str]) -> Any:
    """A part, or one of its settings, as JSON."""
    if isinstance(value, (tuple, list)):
        return [_describe(entry, save) for entry in value]
    if isinstance(value, Pretrained):
        return {"network": _path_of(type(value)), "file": save(value)}
    if value is None or isinstance(value, (bool, int, float, str, torch.dtype, Tensor)):
        return _describe_value(value)
    settings = _settings_of(value)
    if settings is None:
        return {"missing": type(value).__name__}
    return {"part": _path_of(type(value)), "settings": {name: _describe(one, save) for name, one in settings.items()}}


def _describe_value(value: Any) -> Any:
    """A number, a string or a tensor as JSON, which has no infinity and no torch types."""
    if isinstance(value, Tensor):
        return {"tensor": value.detach().cpu().tolist(), "dtype": str(value.dtype).removeprefix("torch.")}
    if isinstance(value, torch.dtype):
        return {"dtype": str(value).removeprefix("torch.")}
    if isinstance(value, float) and not math.isfinite(value):
        return {"number": str(value)}
    return value


def _settings_of(value: Any) -> dict[str, Any] | None:
    """Constructor arguments of a part; None if it does not give them."""
    if isinstance(value, HasSettings):
        return value.part_settings()
    if dataclasses.is_dataclass(value):
        return {one.name: getattr(value, one.name) for one in dataclasses.fields(value) if one.init}
    return None


class _Loader:
    """Makes parts from their descriptions in a planner's file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def part(self, name: str, value: Any) -> Any:
        """The part ``name``; raises `WeightsError` if it cannot be made."""
        try:
            return self.restore(value)
        except (KeyError, TypeError, ValueError, AttributeError, ImportError, RuntimeError, OverflowError) as error:
            if isinstance(error, WeightsError):
                raise WeightsError(f"{name} of {str(self.file)!r}: {error}") from error
            raise WeightsError(f"{name} of {str(self.file)!r} cannot be made: {error!r}") from error

    def restore(self, value: Any) -> Any:
        """Inverse of `_describe`."""
        if isinstance(value, list):
            return tuple(self.restore(entry) for entry in value)
        if not isinstance(value, Mapping):
            return value
        if "missing" in value:
            raise WeightsError(f"it is a {value['missing']}, which no file can hold: give it to from_pretrained")
        if "network" in value:
            return _class_at(value["network"], Pretrained).from_pretrained(self.file.parent / value["file"])
        if "part" in value:
            settings = {name: self.restore(one) for name, one in value["settings"].items()}
            return _class_at(value["part"], None)(**settings)
        return _restore_value(value)


def _restore_value(value: Mapping[str, Any]) -> Any:
    """Inverse of `_describe_value`."""
    if "number" in value:
        return float(value["number"])
    dtype = getattr(torch, value["dtype"])
    if not isinstance(dtype, torch.dtype):
        raise WeightsError(f"torch.{value['dtype']} is not a dtype")
    return torch.tensor(value["tensor"], dtype=dtype) if "tensor" in value else dtype


def _class_at(path: str, base: type | None) -> Any:
    """The class at ``module:Name``, which must be a part or a subclass of ``base``; imports no foreign module."""
    module, _, name = path.partition(":")
    if not module.startswith(OWN) and module not in sys.modules:
        raise WeightsError(f"it is a {path}, of a module that is not imported: import {module} first")
    found = getattr(importlib.import_module(module), name)
    is_part = isinstance(found, type) and (dataclasses.is_dataclass(found) or hasattr(found, "part_settings"))
    if not (is_part if base is None else isinstance(found, type) and issubclass(found, base)):
        raise WeightsError(f"{path} is not a part of a planner")
    return found


def _path_of(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _find(name_or_folder: str | Path) -> Path:
    choices = (Path(name_or_folder) / FILE, SHIPPED / f"planner-{name_or_folder}.json")
    for choice in choices:
        if is_file(choice):
            return choice
    if is_folder(Path(name_or_folder)):
        raise InputError(
            f"folder {str(name_or_folder)!r} holds no planner: it lacks {FILE}, which save_pretrained writes"
        )
    check_choice("planner", str(name_or_folder), shipped_planners())
    raise AssertionError("a planner that ships was not found")


class _Described(TypedDict):
    """Content of ``planner.json`` that is read back."""

    format: str
    parts: dict[str, Any]


def _read(file: Path) -> dict[str, Any]:
    content = read_json(file, WeightsError)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise WeightsError(f"{short_path(file)} describes no planner of this package")
    return check_content(content, _Described, short_path(file), WeightsError)


def _card(content: Mapping[str, Any]) -> str:
    """Model card of a planner, as Markdown."""
    lines = ["# Planner", "", f"- class: {content['class']}"]
    for name, value in content["parts"].items():
        known = value if not isinstance(value, Mapping) else value.get("part") or value.get("network") or "not saved"
        lines.append(f"- {name}: {known}")
    versions = ", ".join(f"{name} {version}" for name, version in library_versions().items() if version)
    return "\n".join([*lines, f"- versions: {versions}", "", f"Every setting is in `{FILE}`.", ""])
