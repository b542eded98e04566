"""How the figures of the benchmarks have changed from commit to commit, as Markdown tables.

    python tools/bench_history.py                             prints the tables
    python tools/bench_history.py --write docs/benchmarks.md  puts them between the marks of that page

It reads the committed versions of `benchmarks/results/*.json` out of git. Machines and loads differ from commit to
commit: a step of a few per cent means nothing.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

BEGIN, END = "<!-- history -->", "<!-- /history -->"
RESULTS = "benchmarks/results"
SERIES = "bench.json"
"""What `torchdyn-plan bench all` writes: the rows of every benchmark, each with its name."""


class Column(NamedTuple):
    """One figure of a benchmark."""

    head: str
    what: tuple[str, ...]
    """Names of the row, the present one first."""
    implementation: str
    batch: int
    compiled: bool = False
    entry: str = "median_us"
    unit: float = 1.0
    """What the entry is divided by."""


OURS, INFERENCE = "torchdyn_plan", "torchdyn_plan, for inference"
TABLES = {
    "kinematics": (
        Column("pose and Jacobian [µs]", ("pose and Jacobian",), OURS, 1),
        Column("compiled [µs]", ("pose and Jacobian",), OURS, 1, compiled=True),
        Column("4096 at once, compiled [µs]", ("pose and Jacobian",), OURS, 4096, compiled=True),
        Column("five damped steps [µs]", ("five damped steps",), OURS, 1),
        Column("pinocchio: pose and Jacobian [µs]", ("pose and Jacobian",), "pinocchio", 1),
        Column("pytorch-kinematics: the same [µs]", ("pose and Jacobian",), "pytorch-kinematics", 1),
    ),
    "replan": (
        Column("plan, corner [ms]", ("re-plan, corner", "re-plan"), OURS, 1, unit=1e3),
        Column("for inference [ms]", ("re-plan, corner",), INFERENCE, 1, unit=1e3),
        Column("plan, wait_and_drop [ms]", ("re-plan, wait_and_drop", "re-plan, meet"), OURS, 1, unit=1e3),
        Column("for inference [ms]", ("re-plan, wait_and_drop", "re-plan, meet"), INFERENCE, 1, unit=1e3),
        Column("1024 plans, corner, for inference [ms]", ("re-plan, corner",), INFERENCE, 1024, unit=1e3),
    ),
    "env": (
        Column("random actions", ("random",), "TrapperEnv", 2048, entry="share_of_raw"),
        Column("pursuit", ("pursuit",), "evaluation loop", 2048, entry="share_of_raw"),
        Column("corner", ("corner",), "evaluation loop", 2048, entry="share_of_raw"),
    ),
}
TITLES = {
    "kinematics": "Kinematics of a UR5, batch 1 unless said otherwise",
    "replan": "A plan, batch 1 unless said otherwise",
    "env": "2048 environments and a planner: share of MuJoCo's own rate",
}
FORMER = {"torchdyn_plan, folded": INFERENCE}
"""Implementations by their former names."""


def main() -> None:
    """Print the tables, or put them into a page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repository", type=Path, default=Path(__file__).resolve().parent.parent)
    parser.add_argument("--write", type=Path, help="page whose tables are replaced")
    given = parser.parse_args()
    text = "\n\n".join(table(given.repository, name) for name in TABLES)
    if given.write is None:
        sys.stdout.write(f"{text}\n")
        return
    page = given.write.read_text()
    before, _, rest = page.partition(BEGIN)
    _, mark, after = rest.partition(END)
    if not mark:
        raise SystemExit(f"{given.write} lacks the marks {BEGIN} and {END}")
    given.write.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}")


def table(repository: Path, name: str) -> str:
    """The history of a benchmark, oldest first: a line for each commit that measured something else."""
    columns = TABLES[name]
    lines: list[list[str]] = []
    for commit, date, rows in versions(repository, name):
        cells = [cell(rows, column) for column in columns]
        if any(one != "–" for one in cells) and (not lines or lines[-1][2:] != cells):
            lines.append([commit, date, *cells])
    head = ["commit", "date", *(column.head for column in columns)]
    body = [head, ["---"] * len(head), *lines]
    return f"### {TITLES[name]}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in body)


def versions(repository: Path, name: str) -> list[tuple[str, str, list[dict[str, Any]]]]:
    """Commit, date and rows of each committed version of a benchmark's figures, oldest first."""
    found = []
    for path in (f"{RESULTS}/{name}.json", f"{RESULTS}/{SERIES}"):
        log = git(repository, "log", "--format=%ct %h %cs", "--", path).splitlines()
        for time, commit, date in map(str.split, log):
            shown = git(repository, "show", f"{commit}:{path}", missing="null")
            content = json.loads(shown)
            rows = content.get("rows", []) if isinstance(content, dict) else content or []
            found.append((int(time), commit, date, [row for row in rows if row.get("benchmark", name) == name]))
    return [version[1:] for version in sorted(found, key=lambda version: version[0])]


def cell(rows: list[dict[str, Any]], column: Column) -> str:
    """A figure among the rows of a version, on a CPU; a dash if it is not among them."""
    for what in column.what:
        for row in rows:
            implementation = FORMER.get(row["implementation"], row["implementation"])
            wanted = (row["what"], implementation, row["batch"], row["compiled"], row.get("device", "cpu"))
            value = row.get(column.entry)
            if wanted == (what, column.implementation, column.batch, column.compiled, "cpu") and value is not None:
                return f"{value / column.unit:.3g}"
    return "–"


def git(repository: Path, *words: str, missing: str | None = None) -> str:
    """What git prints; ``missing`` if it fails and that is given."""
    done = subprocess.run(["git", "-C", str(repository), *words], capture_output=True, text=True, check=False)
    if done.returncode:
        if missing is None:
            raise SystemExit(f"git {words[0]} failed: {done.stderr.strip()}")
        return missing
    return done.stdout


if __name__ == "__main__":
    main()
