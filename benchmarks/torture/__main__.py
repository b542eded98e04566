"""Try all promises; print a table of cases and faults, and write it.

python -m benchmarks.torture --out benchmarks/results/torture.json

A run that was killed goes on with the promises that its file lacks; the figures of the same seed are the same.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

# A process that forks has one thread, in every library.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import tyro

from benchmarks.torture import forked
from benchmarks.torture.promise import Promise
from torchdyn_plan.files import write_json
from torchdyn_plan.versions import library_versions, machine

PROMISES = (
    "bad_rows",
    "bad_actions",
    "mistakes",
    "inverse",
    "weight_files",
    "state_files",
    "training_data",
    "identity",
    "folders",
    "forks",
    "commands",
    "terminals",
    "full_disk",
    "kills",
)
"""Modules of this folder, each with a ``PROMISE``; one that hangs or ends the run is known by its name."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Which promises are tried, and how hard."""

    promises: tuple[str, ...] = PROMISES
    """Names of modules in this folder."""
    size: float = 1.0
    """Cases, as a share of the full number."""
    seed: int = 0
    """Of all that is drawn."""
    out: Path | None = None
    """JSON file for the table; a killed run goes on from it."""
    again: bool = False
    """Try the promises anew that the file has already."""


def main(arguments: Arguments) -> None:
    """Try, save and print; exits 1 where a promise is broken."""
    about = {"size": arguments.size, "seed": arguments.seed}
    rows = _known(arguments, about)
    forked.imported()
    for name in arguments.promises:
        if any(row["promise"] == name for row in rows):
            continue
        promise: Promise = importlib.import_module(f"benchmarks.torture.{name}").PROMISE
        with tempfile.TemporaryDirectory(prefix=f"torture-{name}-") as folder:
            found = promise.run(Random(f"{arguments.seed} {name}"), Path(folder), arguments.size)
        rows.append({"promise": name, "says": promise.says, **found})
        _save(arguments.out, about, rows)
        print(f"{name}: {found['cases']} cases, {found['faults']} faults, {found['seconds']:.0f} s", flush=True)
        for fault in found["told"]:
            print(f"    {fault}", flush=True)
    print(table(rows))
    sys.exit(any(row["faults"] for row in rows))


def _known(arguments: Arguments, about: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of a run that was killed."""
    if arguments.out is None or not arguments.out.exists():
        return []
    content = json.loads(arguments.out.read_text())
    if content["config"] != about:
        raise SystemExit(f"{arguments.out} is of {content['config']}, not of {about}: give another file")
    again = arguments.promises if arguments.again else ()
    return [row for row in content["rows"] if row["promise"] not in again]


def _save(out: Path | None, about: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    if out is not None:
        total = {name: sum(row[name] for row in rows) for name in ("cases", "faults", "seconds")}
        content = {"config": about, "versions": library_versions(), "machine": machine(), "total": total, "rows": rows}
        write_json(out, content)


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown, and their sum."""
    lines = ["| promise | cases | faults | seconds |", "| --- | ---: | ---: | ---: |"]
    total = {name: sum(row[name] for row in rows) for name in ("cases", "faults", "seconds")}
    for row in [*rows, {"says": "all", **total}]:
        lines.append(f"| {row['says']} | {row['cases']} | {row['faults']} | {row['seconds']:.0f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
