"""Rows of a benchmark: each is written to the file before it is shown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torchdyn_plan.errors import InputError, OutputError
from torchdyn_plan.files import check_writable_folder, is_folder, short_path, write_json
from torchdyn_plan.versions import library_versions, machine, source_commit

Row = dict[str, Any]


class Record:
    """The rows of one run of a benchmark, and the file that holds them.

    A run that is killed leaves the rows that it has. Timings belong together: another run starts again, and its first
    row replaces the old file.
    """

    def __init__(
        self, out: str | Path | None = None, *, show: Callable[[Row], object] | None = None, **config: Any
    ) -> None:
        """Begin without rows.

        Args:
            out: JSON file for the rows; None for none.
            show: is given each row once it is saved.
            config: what is run, for the file.

        Raises:
            InputError: ``out`` is no JSON file by its name: plots are put beside it, by names of their own.
            OutputError: no file can be written at ``out``.
        """
        self.rows: list[Row] = []
        self.out, self.show = None if out is None else Path(out), show
        self.about: dict[str, Any] = {"config": config}
        if self.out is not None:
            if is_folder(self.out):
                raise OutputError(f"output file {short_path(self.out)} is a folder")
            if self.out.suffix != ".json":
                raise InputError(f"output file {short_path(self.out)} must end in .json")
            check_writable_folder(self.out.parent)
            self.about |= {"machine": machine(), "versions": library_versions(), "commit": source_commit()}

    def add(self, row: Mapping[str, Any]) -> None:
        """Save ``row`` and show it."""
        self.rows.append(dict(row))
        self._write(complete=False)
        if self.show is not None:
            self.show(self.rows[-1])

    def end(self) -> list[Row]:
        """Say in the file that all rows are there; returns them."""
        self._write(complete=True)
        return self.rows

    def _write(self, *, complete: bool) -> None:
        if self.out is not None:
            rows = [{name: _json(value) for name, value in row.items()} for row in self.rows]
            write_json(self.out, self.about | {"complete": complete, "rows": rows})


def _json(value: Any) -> Any:
    """``value`` as JSON has it: None for a number that is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
