"""Networks as single files: tensors in safetensors, their configuration as JSON in the same file's metadata."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from torchdyn_plan.errors import InputError, WeightsError
from torchdyn_plan.files import write_whole

FORMAT = "torchdyn_plan.network.1"
SHIPPED = Path(__file__).parent.parent / "weights"
"""Folder of the networks that come with the package: ``kind-name.safetensors``."""


class Pretrained:
    """Adds `save_pretrained` and `from_pretrained` to an `nn.Module` built from one configuration dataclass."""

    kind: ClassVar[str]
    """What its files are called before the name."""
    config_type: ClassVar[Callable[..., Any]]
    config: Any

    def save_pretrained(self, path: str | Path) -> Path:
        """Write weights and configuration to one file, whole or not at all.

        Args:
            path: a ``.safetensors`` file, or a folder, which gets ``<kind>.safetensors``.

        Returns:
            The file written. Raises `OutputError` where it cannot be.
        """
        assert isinstance(self, nn.Module)
        file = Path(path)
        if file.suffix != ".safetensors":
            file = file / f"{self.kind}.safetensors"
        tensors = {name: value.detach().cpu().contiguous() for name, value in self.state_dict().items()}
        metadata = {
            "format": FORMAT,
            "class": type(self).__name__,
            "config": json.dumps(dataclasses.asdict(self.config)),
        }
        write_whole(file, lambda temporary: save_file(tensors, temporary, metadata))
        return file

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path, *, device: torch.device | str | None = None) -> Self:
        """Network of this class from a name that ships, a file, or a folder of `save_pretrained` or of a training.

        Raises:
            WeightsError: no such name or file; or a file that is truncated or holds another network.
        """
        file = cls.find(name_or_path)
        metadata, tensors = _read(file)
        if metadata.get("format") != FORMAT or metadata.get("class") != cls.__name__:
            found = metadata.get("class") or "no network of this package"
            raise WeightsError(f"{str(file)!r} holds {found}, expected {cls.__name__}")
        try:
            build: Any = cls
            network = build(cls.config_type(**json.loads(metadata["config"])))
        except (KeyError, TypeError, json.JSONDecodeError, InputError) as error:
            raise WeightsError(f"{str(file)!r} has an invalid configuration of {cls.__name__}: {error}") from error
        _check_tensors(file, network.state_dict(), tensors)
        network.load_state_dict(tensors)
        return network.to(device).eval()

    @classmethod
    def find(cls, name_or_path: str | Path) -> Path:
        """File of the network of that name, or in that file or folder; raises `WeightsError` if there is none."""
        path = Path(name_or_path)
        file = f"{cls.kind}.safetensors"
        choices = (path, path / file, path / cls.kind / file, SHIPPED / f"{cls.kind}-{name_or_path}.safetensors")
        for choice in choices:
            if choice.is_file():
                return choice
        names = sorted(file.stem.removeprefix(f"{cls.kind}-") for file in SHIPPED.glob(f"{cls.kind}-*.safetensors"))
        raise WeightsError(
            f"no weights {str(name_or_path)!r} for {cls.__name__}: neither a file or folder, nor one of the names that "
            f"ship ({', '.join(names) or 'none'})"
        )


def _read(file: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    try:
        with safe_open(file, framework="pt") as content:
            return content.metadata() or {}, {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{str(file)!r} is not a whole safetensors file: {error}") from error


def _check_tensors(file: Path, expected: dict[str, torch.Tensor], found: dict[str, torch.Tensor]) -> None:
    for name in sorted(expected.keys() | found.keys()):
        if name not in found:
            raise WeightsError(f"{str(file)!r} lacks the tensor {name!r}")
        if name not in expected:
            raise WeightsError(f"{str(file)!r} has a foreign tensor {name!r}")
        if found[name].shape != expected[name].shape:
            shapes = f"{tuple(found[name].shape)}, expected {tuple(expected[name].shape)}"
            raise WeightsError(f"{str(file)!r}: tensor {name!r} has shape {shapes}")
