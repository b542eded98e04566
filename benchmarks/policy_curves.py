"""Draw the curves of policy trainings: resting balls trapped over wall time and over transitions.

python benchmarks/policy_curves.py benchmarks/results/policy/curve-seed*.csv --out benchmarks/results/policy/curves.png
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """One line for each training."""

    curves: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Files ``curve.csv`` that trainings wrote."""
    out: Path
    """Picture to write."""


def main(arguments: Arguments) -> None:
    """Read and draw."""
    figure, (over_time, over_data) = plt.subplots(1, 2, figsize=(8.4, 3.4), layout="constrained", sharey=True)
    for path in arguments.curves:
        with path.open() as file:
            rows = [{name: float(value) for name, value in row.items() if value} for row in csv.DictReader(file)]
        success = [row["success"] for row in rows]
        over_time.plot([row["seconds"] / 60.0 for row in rows], success, marker="o", markersize=3, label=path.stem)
        over_data.plot([row["transitions"] / 1e6 for row in rows], success, marker="o", markersize=3, label=path.stem)
    for axes, label in ((over_time, "training time [min]"), (over_data, "transitions [million]")):
        axes.axhline(0.9, color="grey", linewidth=0.8, linestyle="--")
        axes.set(xlabel=label, ylim=(0.0, 1.02))
        axes.grid(alpha=0.3)
    over_time.set_ylabel("resting balls within reach trapped")
    over_data.legend(loc="lower right")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out, dpi=150)
    print(f"written: {arguments.out}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
