"""`torchdyn-plan bench kinematics` compared with a former checkout, in turn, in separate processes on one thread.

    git worktree add /tmp/former 930dcd6
    python benchmarks/kinematics_beside.py --former /tmp/former --out kinematics_beside.json

Other libraries are measured in the process of this checkout. Each figure is the minimum of the rounds' medians.
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro
from sides import Compared, serve, started
from study import Row, Study, each

from torchdyn_plan.bench.kinematics import bench


@dataclass(frozen=True, kw_only=True)
class Arguments(Compared):
    """Measure kinematics."""

    batches: tuple[int, ...] = (1, 4096)
    """Rows at once."""
    seconds: float = 0.5
    """Time spent on each figure."""
    compiled: bool = True
    """Measure compiled forms too."""
    rivals: bool = True
    """Measure other libraries that are installed."""


def measured(line: str, arguments: Arguments) -> Row:
    """Median [µs] of each figure; ``line`` is 1 where other libraries are measured too."""
    rows = bench(
        batches=arguments.batches,
        seconds=arguments.seconds,
        compiled=arguments.compiled,
        rivals=line == "1",
        progress=False,
    )
    return {name(row): row["median_us"] for row in rows}


def name(row: Row) -> str:
    """What a figure is of."""
    how = ", compiled" if row["compiled"] else ""
    return f"{row['what']}, {row['batch']}|{row['implementation']}{how}"


def main(arguments: Arguments) -> None:
    """Measure, save and print."""
    if arguments.side:
        serve(lambda line: measured(line, arguments))
        return
    study = Study(arguments, resume=False)
    words = ["--seconds", str(arguments.seconds), "--batches", *map(str, arguments.batches)]
    words += ["--compiled" if arguments.compiled else "--no-compiled"]
    sides = started("kinematics_beside.py", arguments.former, *words)
    rounds: dict[str, list[Row]] = {key: [] for key in sides}
    for _ in each(range(arguments.repeats), "rounds"):
        for key, side in sides.items():
            rounds[key].append(side.ask("1" if arguments.rivals and key == "now" else "0"))
    least = {key: {what: min(row[what] for row in rows) for what in rows[0]} for key, rows in rounds.items()}
    for what, median in least["now"].items():
        problem, implementation = what.split("|")
        figures = {key: row[what] for key, row in least.items() if what in row}
        study.add({"what": problem, "implementation": implementation, "now": median, **figures})
    for side in sides.values():
        side.close()


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
