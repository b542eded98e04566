"""The figures of a release on episodes that nobody has seen: the split ``final``, played once a release.

    python benchmarks/final.py --rehearse --out runs/rehearsal.json
    python benchmarks/final.py

The record ``benchmarks/results/final-VERSION.json`` names commit and planners before the first episode is played. While
it is there the release is not played again; only a run that was killed goes on, from the same commit with the same
planners. Each release has a series of its own: what one has shown says nothing of the next. A rehearsal plays the split
``dev`` in its place, as often as one likes.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from study import Episodes, Row, Setting, Study, measuring, success_of

from torchdyn_plan.envs.episodes import FINAL
from torchdyn_plan.evaluation.study import check_open
from torchdyn_plan.planners.pretrained import planner_digest
from torchdyn_plan.tasks import load_task
from torchdyn_plan.versions import library_versions, source_commit

TASK = "trapper"
RECORDS = Path(__file__).parent / "results"


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """What is played; a release plays all of it."""

    planners: tuple[str, ...] = ("wait_and_drop", "untrained")
    """Of the task."""
    velocities: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """Of the ball at the start [m/s]."""
    episodes: int = 1000
    """Episodes for each row."""
    num_envs: int = 1000
    """Episodes side by side; does not change the figures."""
    rehearse: bool = False
    """Play the split dev, and record nothing of a release."""

    def __post_init__(self) -> None:
        """Any split: `of_release` alone gives ``final``."""


def of_release(arguments: Arguments, release: str, commit: str | None) -> Arguments:
    """What the ``release`` plays at ``commit``, and where its record is.

    Raises:
        SystemExit: something else was asked for, or the commit is not known.
    """
    default = Arguments()
    if replace(arguments, num_envs=default.num_envs, threads=default.threads) != default:
        raise SystemExit("a release plays what it always plays: only --num-envs and --threads may be given")
    if commit is None or commit.endswith("-dirty"):
        raise SystemExit(f"a release is played from a commit of its own, not from {commit}: commit the changes first")
    return replace(arguments, split=FINAL, seed=series_of(release), out=RECORDS / f"final-{release}.json")


def series_of(release: str) -> int:
    """The series of episodes of a release."""
    return int.from_bytes(hashlib.sha256(release.encode()).digest()[:4], "big")


def open_release(study: Study, opening: Row, count: int) -> None:
    """Record that the release is played; ``count`` rows follow the record.

    Raises:
        SystemExit: it has been played, or another commit or planner has begun to play it.
    """
    if not study.rows:
        study.add(opening)
        return
    file, begun = study.arguments.out, study.rows[0]
    if begun != opening:
        raise SystemExit(f"release {opening['release']} was opened before with other planners or commit, see {file}")
    if len(study.rows) > count:
        raise SystemExit(f"release {opening['release']} was opened before: its figures are in {file}")


def main(arguments: Arguments) -> None:
    """Open, play and record."""
    task, release, commit = load_task(TASK), str(library_versions()["torchdyn-plan"]), source_commit()
    if arguments.rehearse:
        check_open(arguments.split)
    else:
        arguments = of_release(arguments, release, commit)
    study = Study(arguments, scene=task.digest())
    settings = [Setting(task, arguments, velocity=velocity) for velocity in arguments.velocities]
    planners = {name: settings[0].planner(name) for name in arguments.planners}
    if not arguments.rehearse:
        digests = {name: planner_digest(planner) for name, planner in planners.items()}
        opening = {"release": release, "commit": commit, "planners": digests, "seed": arguments.seed}
        open_release(study, opening, len(settings) * len(planners))
    with measuring():
        for setting in settings:
            for name, planner in planners.items():

                def measure(setting: Setting = setting, name: str = name, planner: object = planner) -> Row:
                    return success_of(setting.play(planner, name))

                study.row({"planner": name, **setting.about}, measure)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
