"""Files that are whole or absent: written in a folder beside their final place, then renamed to it.

Every file that this package writes, and every JSON or safetensors file that it reads back, passes through here, so that
a full disk, a folder that cannot be entered or a damaged file is the same clear error everywhere.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from torchdyn_plan.errors import InputError, OutputError, TorchdynPlanError

if TYPE_CHECKING:
    from torch import Tensor

TEMPORARY = ".torchdyn_plan-"
"""Names of the folders in which files are made begin so, and no others."""
LOCK = "lock"
"""Held by the process that writes in such a folder."""
SOON = 60.0
"""A writer has its lock so soon after it has made its folder [s]."""
_tidied: set[Path] = set()


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file of the same name, then rename it to ``path``.

    A crash or a full disk leaves whatever was at ``path`` untouched; raises `OutputError`.
    """
    from safetensors import SafetensorError

    if "\0" in str(path):
        raise OutputError(f"cannot write {short_path(path)}: no name has a null in it")
    try:
        with no_empty_folders(path.parent), _workplace(path.parent) as (place, mode):
            temporary = place / path.name
            write(temporary)
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
            # Some libraries make files that nobody else may read.
            temporary.chmod(mode)
            temporary.replace(path)
    except (OSError, SafetensorError) as error:
        raise OutputError(f"cannot write {short_path(path)}: {reason(error)}") from error


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` to ``path`` as indented JSON, whole or not at all."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write ``tensors`` to ``path`` as safetensors, whole or not at all; those that share memory are written apart."""
    from safetensors.torch import save_file

    apart, about = _apart(tensors), None if metadata is None else {**metadata}
    write_whole(path, lambda temporary: save_file(apart, temporary, about))


def read_json(path: Path, error: type[TorchdynPlanError] = InputError) -> Any:
    """What the JSON file at ``path`` holds; raises ``error`` where it cannot be read or is no JSON."""
    try:
        return parse_json(path.read_bytes())
    except (OSError, ValueError) as cause:
        raise error(f"{short_path(path)} is no JSON file: {reason(cause)}") from cause


def parse_json(text: str | bytes) -> Any:
    """``text`` as JSON, which has no NaN and is not nested without end; raises `ValueError`."""
    try:
        return json.loads(text, parse_constant=_no_number)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def read_metadata(path: Path, error: type[TorchdynPlanError]) -> dict[str, str]:
    """Metadata of the safetensors file at ``path``; raises ``error`` where it is not whole."""
    with open_tensors(path, error) as content:
        return content.metadata() or {}


def read_tensors(path: Path, error: type[TorchdynPlanError]) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors of the safetensors file at ``path``; raises ``error`` where it is not whole."""
    with open_tensors(path, error) as content:
        return content.metadata() or {}, {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118


def tensor_bytes(tensor: Tensor) -> memoryview:
    """The numbers of ``tensor`` one after the other, for a digest."""
    import torch

    # A single number of a larger tensor keeps its stride, and cannot be looked at as bytes: a copy can.
    flat = tensor.detach().cpu().reshape(-1).clone(memory_format=torch.contiguous_format)
    return flat.view(torch.uint8).numpy().data


@contextlib.contextmanager
def open_tensors(path: Path, error: type[TorchdynPlanError]) -> Iterator[Any]:
    """The safetensors file at ``path``, of which nothing but the header is read; raises ``error`` if it is damaged."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as content:
            yield content
    except (SafetensorError, OSError, ValueError, OverflowError, MemoryError) as cause:
        if isinstance(cause, TorchdynPlanError):
            raise
        raise error(f"{short_path(path)} is not a whole safetensors file: {reason(cause)}") from cause


def files_in(folder: Path, pattern: str, error: type[TorchdynPlanError] = InputError) -> list[Path]:
    """Files in ``folder`` whose names fit ``pattern``, in order; raises ``error`` if it cannot be looked into."""
    try:
        return sorted(folder.glob(pattern))
    except (OSError, ValueError) as cause:
        raise error(f"folder {short_path(folder)} cannot be read: {reason(cause)}") from cause


def exists(path: Path) -> bool:
    """Whether something is at ``path``; no for a place that cannot be looked at, as a name that is too long."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def is_file(path: Path) -> bool:
    """Whether a file is at ``path``; no for a place that cannot be looked at, as a name that is too long."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Whether a folder is at ``path``; no for a place that cannot be looked at, as a name that is too long."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def check_writable_folder(folder: Path) -> Path:
    """Create ``folder`` if needed and return it; raise `OutputError` if it cannot be written to."""
    try:
        with no_empty_folders(folder), _workplace(folder) as (place, _):
            (place / "probe").write_bytes(b"x")
    except (OSError, ValueError) as error:
        raise OutputError(f"output folder {short_path(folder)} is not writable: {reason(error)}") from error
    return folder


@contextlib.contextmanager
def no_empty_folders(folder: Path) -> Iterator[None]:
    """Folders that are made on the way to ``folder`` meanwhile go again if an error leaves them empty."""
    made = [one for one in (folder, *folder.parents) if not exists(one)]
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError, ValueError):
            for one in made:
                if exists(one):
                    one.rmdir()
        raise


def short_path(path: Path) -> str:
    """``path`` in quotes for a message, its middle left out if it is very long."""
    text = str(path)
    return repr(text if len(text) <= 300 else f"{text[:140]}…{text[-140:]}")


def reason(error: BaseException) -> str:
    """What went wrong, in one line."""
    text = (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__
    return text.splitlines()[0]


@contextlib.contextmanager
def _workplace(folder: Path) -> Iterator[tuple[Path, int]]:
    """A new folder within ``folder``, which is made if needed, and the mode that files get; it is gone afterwards."""
    folder.mkdir(parents=True, exist_ok=True)
    _tidy(folder)
    place, lock = _locked_folder(folder)
    try:
        yield place, os.fstat(lock.fileno()).st_mode & 0o777
    finally:
        lock.close()
        shutil.rmtree(place, ignore_errors=True)


def _locked_folder(folder: Path) -> tuple[Path, BinaryIO]:
    """A new folder within ``folder``, and the lock that is held on it."""
    while True:
        place = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=folder))
        try:
            lock = (place / LOCK).open("wb")
        except BaseException:
            shutil.rmtree(place, ignore_errors=True)
            raise
        # Who tidies up may have come before the lock, and takes the folder for one that was left.
        if _take(lock) is not False and (place / LOCK).exists():
            return place, lock
        lock.close()


def _tidy(folder: Path) -> None:
    """Remove what writers that were killed have left in ``folder``: once, and nothing of writers that live."""
    if folder in _tidied:
        return
    _tidied.add(folder)
    for place in folder.glob(f"{TEMPORARY}*"):
        with contextlib.suppress(OSError):
            if _is_left(place):
                shutil.rmtree(place, ignore_errors=True)


def _is_left(place: Path) -> bool:
    """Whether no process writes in ``place`` any more."""
    if not (place / LOCK).exists():
        return time.time() - place.stat().st_mtime > SOON
    with (place / LOCK).open("rb+") as lock:
        return _take(lock) is True


def _take(lock: BinaryIO) -> bool | None:
    """Lock an open file until it is closed: whether nobody else had it, or None where there are no locks."""
    try:
        import fcntl
    except ImportError:
        return None
    try:
        fcntl.flock(lock.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _apart(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """``tensors``, each contiguous and in a memory of its own, as safetensors wants them."""
    apart: dict[str, Tensor] = {}
    known: set[int] = set()
    for name, tensor in tensors.items():
        memory = tensor.untyped_storage().data_ptr()
        apart[name] = tensor.clone() if memory in known else tensor.contiguous()
        known.add(memory)
    return apart


def _no_number(word: str) -> Any:
    raise ValueError(f"{word} is no number")
