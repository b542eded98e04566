"""Draw success over the noise of a 60 Hz sensor, for each planner.

python benchmarks/sensor_curves.py benchmarks/results/sensor_curves.json --out docs/sensors.png
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt

LABELS = {
    "wait_and_drop": ("forecaster that has seen noise", "#0072B2", "o"),
    "exact_forecast": ("forecaster that has seen none", "#D55E00", "s"),
    "billiard": ("billiard, not trained", "#009E73", "^"),
    "constant_velocity": ("constant velocity", "#CC79A7", "D"),
    "held": ("no track: newest measurement held", "#7F7F7F", "x"),
}
"""Name, colour and marker of each line."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """One line for each planner."""

    figures: Annotated[Path, tyro.conf.Positional]
    """File of ``benchmarks/sensors.py``."""
    out: Path
    """Picture to write."""
    velocity: float = 3.0
    """Of the ball at the start [m/s]."""


def main(arguments: Arguments) -> None:
    """Read and draw."""
    rows = [row for row in json.loads(arguments.figures.read_text())["rows"] if row["velocity"] == arguments.velocity]
    figure, axes = plt.subplots(figsize=(6.0, 3.8), layout="constrained")
    for name, (label, colour, marker) in LABELS.items():
        line = sorted(points(rows, name))
        if line:
            noise, value, low, high = zip(*line, strict=True)
            axes.fill_between(noise, low, high, color=colour, alpha=0.12, linewidth=0)
            axes.plot(noise, value, color=colour, marker=marker, markersize=4, label=label)
    axes.set(xlabel="standard deviation of a measurement [mm]", ylabel="solvable balls trapped", ylim=(0.0, 1.0))
    axes.set_title(f"balls of {arguments.velocity:g} m/s, 60 measurements a second, Kalman track", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(loc="center right", fontsize=8)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out, dpi=150)
    print(f"written: {arguments.out}")


def points(rows: list[dict[str, Any]], name: str) -> list[tuple[float, float, float, float]]:
    """Noise [mm], success and its interval of the planner ``name``, ``held`` for that without a track."""
    found = []
    for row in rows:
        noise, _, rate = row["sensor"].partition(" mm, ")
        track, planner = ("held", "wait_and_drop") if name == "held" else ("kalman", name)
        if rate == "60 Hz" and (row["track"], row["planner"]) == (track, planner):
            found.append((float(noise), row["success_solvable"], *row["success_solvable_ci"]))
    return found


if __name__ == "__main__":
    main(tyro.cli(Arguments))
