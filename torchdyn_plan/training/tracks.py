"""Your own recordings of targets: read from a file, and resampled to a task's control steps."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdyn_plan.errors import InputError
from torchdyn_plan.files import is_file, short_path

COLUMNS = {
    "time": ("time", "t", "timestamp"),
    "x": ("x",),
    "y": ("y",),
    "z": ("z",),
    "track": ("track", "track_id", "id"),
}
"""Columns of a recording and their accepted names; ``z`` and ``track`` may be absent."""
NEEDED = ("time", "x", "y")
GAP = 5.0
"""A track is split where two samples are more than this many usual intervals apart."""
FARTHEST = 1e6
"""Largest allowed distance from the origin [m]."""
MOST = 50_000_000
"""Most samples after resampling: with more, the time is probably not in seconds."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Recorded tracks of targets, ``n`` samples in the order of the file."""

    time: np.ndarray[Any, Any]
    """``(n,)`` [s]."""
    place: np.ndarray[Any, Any]
    """``(n, 3)`` [m, world]; height 0 where the file has none."""
    track: np.ndarray[Any, Any]
    """``(n,)`` number of each sample's track."""
    rows: np.ndarray[Any, Any]
    """``(n,)`` row of each sample in the file."""
    file: Path
    """The file."""

    def rest(self, name: str, index: int) -> str:
        """The file, row and column of an entry, for messages."""
        return f"{short_path(self.file)}, row {self.rows[index]}, column {name}"


def read_tracks(file: Path) -> Tracks:
    """The tracks in ``file``, ``.csv``, ``.parquet``, ``.npy`` or ``.npz``.

    Columns are time [s], x, y and, in space, z [m, world], and the track's name; further columns are ignored. A
    ``.npy`` without names has them in this order, with the track's number last. Rows of a CSV are counted from its
    header, which is row 1; rows of other files from 0.

    Raises:
        InputError: there is no such file, a column is missing, an entry is not a number or too large, or a sample is
            not later than the previous one of its track; the message names the row and the column.
    """
    file = Path(file)
    if not is_file(file):
        raise InputError(f"there is no file of tracks {short_path(file)}")
    readers = {".csv": _read_csv, ".parquet": _read_parquet, ".npy": _read_numpy, ".npz": _read_numpy}
    if file.suffix.lower() not in readers:
        raise InputError(f"{short_path(file)} must be one of {', '.join(readers)}")
    columns, first = readers[file.suffix.lower()](file)
    count = len(columns["time"])
    if not count:
        raise InputError(f"{short_path(file)} holds no samples")
    rows = np.arange(first, first + count)
    numbers = {name: _numbers(file, name, values, rows) for name, values in columns.items() if name != "track"}
    height = numbers.get("z", np.zeros(count))
    place = np.stack([numbers["x"], numbers["y"], height], axis=-1)
    names = columns.get("track", np.zeros(count, dtype=np.int64))
    _, track = np.unique(np.asarray(names).astype(str), return_inverse=True)
    found = Tracks(time=numbers["time"], place=place, track=track.reshape(-1), rows=rows, file=file)
    _check_order(found)
    return found


def at_control_steps(tracks: Tracks, control_step: float) -> list[Tensor]:
    """Positions ``(T, 3)`` float32 of each track at every control step from its first sample, by linear interpolation.

    A track is split at gaps (`GAP`); pieces of fewer than two samples are dropped.
    """
    spans = list(_pieces(tracks, control_step))
    total = sum(tracks.time[piece[-1]] - tracks.time[piece[0]] for piece in spans) / control_step
    if total > MOST:
        raise InputError(
            f"{short_path(tracks.file)}, column time: must be in seconds, got tracks of {total:.0f} control steps of "
            f"{control_step:g} s"
        )
    found = []
    for piece in spans:
        time = tracks.time[piece]
        steps = int((time[-1] - time[0]) / control_step + 1e-6) + 1
        moments = time[0] + control_step * np.arange(steps)
        place = [np.interp(moments, time, tracks.place[piece, axis]) for axis in range(3)]
        if steps > 1:
            found.append(torch.from_numpy(np.stack(place, axis=-1)).float())
    return found


def shard_of(paths: Sequence[Tensor], control_step: float) -> dict[str, Tensor]:
    """``paths`` (T, 3) of any lengths as a data shard, with the mean speed of each [m/s]."""
    length = torch.tensor([len(path) for path in paths])
    ways = [path.diff(dim=0).norm(dim=-1).sum() / ((len(path) - 1) * control_step) for path in paths]
    return {
        "positions": torch.cat(list(paths)),
        "start": length.cumsum(0) - length,
        "length": length,
        "pocketed": torch.zeros(len(paths), dtype=torch.bool),
        "velocity": torch.stack(ways),
    }


def _pieces(tracks: Tracks, control_step: float) -> Iterator[np.ndarray[Any, Any]]:
    """Indices of the samples of each piece without gaps, at least two samples long."""
    order = np.argsort(tracks.track, kind="stable")
    ends = np.flatnonzero(np.diff(tracks.track[order])) + 1
    for rows in np.split(order, ends):
        apart = np.diff(tracks.time[rows])
        if not len(apart):
            continue
        longest = max(GAP * float(np.median(apart)), 2.0 * control_step)
        yield from (piece for piece in np.split(rows, np.flatnonzero(apart > longest) + 1) if len(piece) > 1)


def _check_order(tracks: Tracks) -> None:
    """Raise `InputError` where a sample is not later than the one before it of the same track."""
    order = np.argsort(tracks.track, kind="stable")
    time, same = tracks.time[order], np.diff(tracks.track[order]) == 0
    late = np.flatnonzero(same & (np.diff(time) <= 0.0))
    if len(late):
        index = order[late + 1].min()
        before = tracks.time[order[np.flatnonzero(order == index)[0] - 1]]
        raise InputError(
            f"{tracks.rest('time', index)}: must be later than {before:g} s, the sample before it of the same track, "
            f"got {tracks.time[index]:g} s"
        )


def _numbers(file: Path, name: str, values: Any, rows: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """``values`` of a column as float64; raises `InputError` for the first that is not a number or too large."""
    try:
        found = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.array([_number(value) for value in values])
    limit = np.inf if name == "time" else FARTHEST
    bad = np.flatnonzero(~(np.isfinite(found) & (np.abs(found) <= limit)))
    if len(bad):
        place = f"{short_path(file)}, row {rows[bad[0]]}, column {name}"
        size = "" if name == "time" else f" of at most {FARTHEST:g} m"
        value = values[bad[0]]
        raise InputError(f"{place}: must be a number{size}, got {value.item() if hasattr(value, 'item') else value!r}")
    return found


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def _chosen(file: Path, columns: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a recording by their standard names; raises `InputError` if one is missing or duplicated."""
    lowered = {str(name).strip().lower(): values for name, values in columns.items()}
    found: dict[str, Any] = {}
    for name, calls in COLUMNS.items():
        there = [call for call in calls if call in lowered]
        if len(there) > 1:
            raise InputError(f"{short_path(file)} has several columns for {name}: {', '.join(there)}")
        if there:
            found[name] = lowered[there[0]]
        elif name in NEEDED:
            known = ", ".join(map(str, columns)) or "none"
            raise InputError(f"{short_path(file)} lacks a column {' or '.join(calls)}; it has: {known}")
    return found


def _read_csv(file: Path) -> tuple[dict[str, Any], int]:
    """Columns of a CSV with a header, as text, and the number of its first row of samples."""
    with file.open(encoding="utf-8-sig", newline="") as opened:
        try:
            header, *lines = list(csv.reader(opened)) or [[]]
        except (UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{short_path(file)} is not a CSV file: {error}") from error
    while lines and not lines[-1]:
        lines.pop()
    for number, line in enumerate(lines, start=2):
        if len(line) != len(header):
            raise InputError(f"{short_path(file)}, row {number}: must have {len(header)} columns, got {len(line)}")
    columns = {name: [line[place].strip() for line in lines] for place, name in enumerate(header)}
    return _chosen(file, columns), 2


def _read_parquet(file: Path) -> tuple[dict[str, Any], int]:
    """Columns of a Parquet file, as `_read_csv`."""
    try:
        arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError as error:
        raise InputError(f"{short_path(file)} needs pyarrow, which is not installed: pip install pyarrow") from error
    try:
        table = parquet.read_table(file)
    except (arrow.ArrowException, OSError) as error:
        raise InputError(f"{short_path(file)} is not a Parquet file: {error}") from error
    # Missing values become None.
    return _chosen(file, {name: table[name].to_pylist() for name in table.column_names}), 0


def _read_numpy(file: Path) -> tuple[dict[str, Any], int]:
    """Columns of a structured array, of a plain array in the standard order, or of several arrays; like `_read_csv`."""
    try:
        loaded = np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{short_path(file)} is not a NumPy file without pickles: {error}") from error
    if not isinstance(loaded, np.ndarray):
        columns = _chosen(file, {name: loaded[name] for name in loaded.files})
        shapes = {name: values.shape for name, values in columns.items()}
        if any(shape != (len(columns["time"]),) for shape in shapes.values() if shapes["time"]) or not shapes["time"]:
            raise InputError(f"{short_path(file)}: columns must be of one length, got {shapes}")
        return columns, 0
    if loaded.dtype.names:
        return _chosen(file, {name: loaded[name].reshape(-1) for name in loaded.dtype.names}), 0
    names = {4: ("time", "x", "y", "track"), 5: ("time", "x", "y", "z", "track")}
    if loaded.ndim != 2 or loaded.shape[1] not in names:
        raise InputError(
            f"{short_path(file)} must have shape (n, 4), columns time, x, y, track, or (n, 5) with z before the last, "
            f"got {loaded.shape}"
        )
    return dict(zip(names[loaded.shape[1]], loaded.T, strict=True)), 0
