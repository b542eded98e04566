"""Networks as single files: tensors in safetensors, their configuration as JSON in the same file's metadata."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_finite
from torchdyn_plan.errors import InputError, WeightsError
from torchdyn_plan.files import is_file, open_tensors, parse_json, reason, short_path, write_tensors
from torchdyn_plan.schemas import check_settings

FORMAT = "torchdyn_plan.network.1"
SHIPPED = Path(__file__).parent.parent / "weights"
"""Folder of the networks shipped with the package: ``kind-name.safetensors``."""


class Pretrained:
    """Adds `save_pretrained` and `from_pretrained` to an `nn.Module` built from one configuration dataclass."""

    kind: ClassVar[str]
    """Prefix of its file names."""
    config_type: ClassVar[Callable[..., Any]]
    config: Any

    def save_pretrained(self, path: str | Path) -> Path:
        """Write weights and configuration to one file, atomically; weights are written as float32.

        Args:
            path: a ``.safetensors`` file, or a folder, which gets ``<kind>.safetensors``.

        Returns:
            The file written.

        Raises:
            InputError: a weight is NaN or infinite, also as float32.
            OutputError: the file cannot be written.
        """
        assert isinstance(self, nn.Module)
        file = Path(path)
        if file.suffix != ".safetensors":
            file = file / f"{self.kind}.safetensors"
        tensors = {name: _as_kept(value).cpu().contiguous() for name, value in self.state_dict().items()}
        for name, value in tensors.items():
            check_finite(f"{name} of {type(self).__name__}", value)
        metadata = {
            "format": FORMAT,
            "class": type(self).__name__,
            "config": json.dumps(dataclasses.asdict(self.config)),
        }
        write_tensors(file, tensors, metadata)
        return file

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path, *, device: torch.device | str | None = None) -> Self:
        """Network of this class from a shipped name, a file, or a folder written by `save_pretrained` or a training.

        Raises:
            WeightsError: there is no such name or file, or the file is truncated, holds another network, or weights
                that are not finite float32 numbers. The file's header is checked before anything is allocated.
        """
        file = cls.find(name_or_path)
        build: Any = cls
        with open_tensors(file, WeightsError) as content:
            config = cls._read_config(file, content.metadata() or {})
            found = {name: content.get_slice(name) for name in content.keys()}  # noqa: SIM118
            _check_header(file, cls._expected(file, config), found)
            tensors = {name: content.get_tensor(name) for name in found}
        for name, tensor in tensors.items():
            if not bool(torch.isfinite(tensor).all()):
                raise WeightsError(f"{short_path(file)}: tensor {name!r} holds NaN or infinite values")
        network = build(config)
        network.load_state_dict(tensors)
        return network.to(device).eval()

    @classmethod
    def _read_config(cls, file: Path, metadata: Mapping[str, str]) -> Any:
        """Configuration in the file's ``metadata``; raises `WeightsError` if it is not one of this network."""
        if metadata.get("format") != FORMAT or metadata.get("class") != cls.__name__:
            found = metadata.get("class") or "no network of this package"
            raise WeightsError(f"{short_path(file)} holds {found}, expected {cls.__name__}")
        try:
            settings = check_settings(parse_json(metadata["config"]), cls.config_type, "config", InputError)
            return cls.config_type(**settings)
        except (KeyError, TypeError, ValueError) as error:
            raise cls._invalid(file, error) from error

    @classmethod
    def _expected(cls, file: Path, config: Any) -> dict[str, Tensor]:
        """Tensors of the network with this configuration, on the meta device: they take no memory."""
        build: Any = cls
        try:
            with torch.device("meta"):
                return build(config).state_dict()
        except (RuntimeError, TypeError, ValueError, OverflowError, MemoryError) as error:
            raise cls._invalid(file, error) from error

    @classmethod
    def _invalid(cls, file: Path, error: Exception) -> WeightsError:
        return WeightsError(f"{short_path(file)} has an invalid configuration of {cls.__name__}: {reason(error)}")

    @classmethod
    def find(cls, name_or_path: str | Path) -> Path:
        """File of the network of that name, or in that file or folder; raises `WeightsError` if there is none."""
        path = Path(name_or_path)
        file = f"{cls.kind}.safetensors"
        choices = (path, path / file, path / cls.kind / file, SHIPPED / f"{cls.kind}-{name_or_path}.safetensors")
        for choice in choices:
            if is_file(choice):
                return choice
        names = sorted(file.stem.removeprefix(f"{cls.kind}-") for file in SHIPPED.glob(f"{cls.kind}-*.safetensors"))
        raise WeightsError(
            f"no weights {short_path(path)} for {cls.__name__}: neither a file or folder, nor one of the names that "
            f"ship ({', '.join(names) or 'none'})"
        )


def _as_kept(tensor: Tensor) -> Tensor:
    """``tensor`` as it is stored in files."""
    return tensor.detach().float() if tensor.is_floating_point() else tensor.detach()


def _check_header(file: Path, expected: Mapping[str, Tensor], found: Mapping[str, Any]) -> None:
    """Raise `WeightsError` unless the tensors ``found`` in the header have the expected names, shapes and types."""
    for name in sorted(expected.keys() | found.keys()):
        if name not in found:
            raise WeightsError(f"{short_path(file)} lacks the tensor {name!r}")
        if name not in expected:
            raise WeightsError(f"{short_path(file)} has a foreign tensor {name!r}")
        shape = tuple(found[name].get_shape())
        if shape != tuple(expected[name].shape):
            shapes = f"{shape}, expected {tuple(expected[name].shape)}"
            raise WeightsError(f"{short_path(file)}: tensor {name!r} has shape {shapes}")
        kept = _KINDS.get(_as_kept(torch.empty(0, dtype=expected[name].dtype)).dtype)
        if found[name].get_dtype() != kept:
            raise WeightsError(f"{short_path(file)}: tensor {name!r} is {found[name].get_dtype()}, expected {kept}")


_KINDS = {torch.float32: "F32", torch.int64: "I64", torch.int32: "I32", torch.bool: "BOOL"}
"""Names of tensor types in files."""
