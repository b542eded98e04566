"""Are the episodes of two runs the same, bit for bit? Compares what `torchdyn-plan evaluate --out` wrote.

    python benchmarks/same_episodes.py runs/before runs/after

Each argument is a folder of folders with ``episodes.json``, or one such folder; folders of the same name are compared.
Wall times are ignored. Former names of planners and tasks are translated to their present ones.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PLANNERS = {"meet": "wait_and_drop"}
"""Former names of planners, and the present ones."""
FORMER_REACH = "reach"
"""Former name of the task `fetch_reach`, whose results were told in Trapper's words."""
REACH_WORDS = {"trapped": "reached", "steps": "steps", "replans": "replans", "solvable": "solvable"}
"""The words of that task's results, formerly and now; it had others, which said nothing."""

Episodes = dict[str, dict[str, Any]]
"""Lists of outcomes by name, by planner."""


def read(folder: Path) -> Episodes:
    """Outcomes in ``folder`` by their present names, without wall times."""
    task = json.loads((folder / "results.json").read_text())["config"]["task"]
    found = {}
    for planner, outcomes in json.loads((folder / "episodes.json").read_text()).items():
        words = REACH_WORDS if task == FORMER_REACH else {name: name for name in outcomes if name != "seconds"}
        found[PLANNERS.get(planner, planner)] = {now: outcomes[formerly] for formerly, now in words.items()}
    return found


def difference(before: dict[str, Any], after: dict[str, Any]) -> str:
    """The first difference between the outcomes of one planner; empty if there is none."""
    if before.keys() != after.keys():
        return f"entries {' '.join(sorted(before.keys() ^ after.keys()))} are in one of them only"
    for name, values in before.items():
        if len(values) != len(after[name]):
            return f"{len(values)} episodes before, {len(after[name])} after"
        different = [row for row, pair in enumerate(zip(values, after[name], strict=True)) if pair[0] != pair[1]]
        if different:
            row = different[0]
            changed = f"{name} of episode {row} is {values[row]} before, {after[name][row]} after"
            return f"{changed} ({len(different)} of {len(values)} differ)"
    return ""


def pairs(before: Path, after: Path) -> Iterator[tuple[str, Path, Path]]:
    """Folders of results that are to be the same, with their name."""
    if (before / "episodes.json").is_file():
        yield before.name, before, after
        return
    for file in sorted(before.glob("*/episodes.json")):
        yield file.parent.name, file.parent, after / file.parent.name


def main(before: Path, after: Path) -> int:
    """Print a line for each planner at each setting; returns the number of those that differ."""
    lines = []
    for name, one, other in pairs(before, after):
        if not (other / "episodes.json").is_file():
            lines.append((name, "", f"no results in {other}"))
            continue
        former, present = read(one), read(other)
        for planner in former | present:
            if planner in former and planner in present:
                count = len(former[planner]["steps"])
                found = difference(former[planner], present[planner])
                lines.append((name, f"{planner}, {count} episodes", found))
            else:
                lines.append((name, planner, f"only {'before' if planner in former else 'after'}"))
    for name, planner, found in lines:
        print(f"{name:28} {planner:30} {found or 'identical'}")
    return sum(1 for _, _, found in lines if found)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python benchmarks/same_episodes.py BEFORE AFTER")
    different = main(Path(sys.argv[1]), Path(sys.argv[2]))
    sys.exit(1 if different else 0)
