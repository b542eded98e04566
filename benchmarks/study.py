"""Common code of the studies in this folder: arguments, rows that survive a kill, and the result file.

A study is a script that measures rows one after another. Each row is identified by what it depends on, and is saved
before it is printed: a killed run continues where it was, and a closed terminal loses nothing.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tqdm import tqdm

from torchdyn_plan.evaluation.episodes import find_truth, run_episodes
from torchdyn_plan.evaluation.intervals import mcnemar, paired_loss, rate
from torchdyn_plan.evaluation.results import EpisodeOutcomes
from torchdyn_plan.evaluation.study import check_open
from torchdyn_plan.files import write_json
from torchdyn_plan.tasks import Task, Truth
from torchdyn_plan.threads import one_thread
from torchdyn_plan.versions import library_versions, machine

if TYPE_CHECKING:
    # Not where it runs: sides of a comparison import this module with a former package, which may have no sensors.
    from torchdyn_plan.envs.sensor import Sensor

Row = dict[str, Any]

NOT_PRINTED = ("lost", "trapped", "settings", "list")
"""Entries of rows that are only saved."""


@dataclass(frozen=True, kw_only=True)
class Output:
    """Arguments of every study."""

    out: Path | None = None
    """JSON file for the figures, with which a killed run continues; they are only printed for None."""


@dataclass(frozen=True, kw_only=True)
class Episodes(Output):
    """Arguments of a study that plays episodes."""

    episodes: int = 300
    """Episodes for each row."""
    split: str = "dev"
    """Series of episodes: test, or dev while tuning."""
    seed: int = 0
    """Which series."""
    num_envs: int = 300
    """Episodes side by side; does not change the figures."""
    threads: int = 0
    """Threads of the simulation, 0 for all cores; does not change the figures."""

    def __post_init__(self) -> None:
        """Raise `InputError` for a split that is not for studies."""
        check_open(self.split)


class Study:
    """Rows of one run of a study, and the file that holds them."""

    def __init__(self, arguments: Output, *, scene: str | None = None, resume: bool = True) -> None:
        """Continue with the rows in the file of ``arguments``, if there is one.

        Exits where the file holds rows of another scene, or of another version of this package.

        Args:
            arguments: of the study.
            scene: digest of the scene; None for a study without one.
            resume: False for timings, which are taken anew.
        """
        self.arguments, self.scene = arguments, scene
        self.rows: list[Row] = []
        file = arguments.out
        if resume and file is not None and file.exists():
            content = json.loads(file.read_text())
            if content.get("scene") != scene:
                raise SystemExit(f"{file} holds rows of the scene {content.get('scene')}, not of {scene}")
            made, here = content["versions"].get("torchdyn-plan"), library_versions()["torchdyn-plan"]
            if made != here:
                raise SystemExit(f"{file} holds rows of version {made}, not of {here}: give another file")
            self.rows = content["rows"]

    def row(self, about: Row, measure: Callable[[], Row]) -> Row:
        """The row that depends on ``about``: the one that is there already, or measured now, saved and printed."""
        for row in self.rows:
            if about.items() <= row.items():
                return row
        return self.add(about | measure())

    def add(self, row: Row) -> Row:
        """Save and print ``row``."""
        row = {name: _json(value) for name, value in row.items()}
        self.rows.append(row)
        self.save()
        tqdm.write(told(row))
        return row

    def save(self, **more: Any) -> None:
        """Write all rows; ``more`` is written beside them."""
        if self.arguments.out is None:
            return
        # Not where it was written: that is a path of somebody's machine.
        kept = {name: value for name, value in dataclasses.asdict(self.arguments).items() if name != "out"}
        config = {name: _json(value) for name, value in kept.items()}
        about = {"machine": machine(), "versions": library_versions(), "scene": self.scene, "config": config}
        write_json(self.arguments.out, about | more | {"rows": self.rows})


class Setting:
    """Episodes of a task at one setting, of which what is known beforehand is found when it is asked for."""

    def __init__(self, task: Task, arguments: Episodes, *, static: str | None = None, **settings: Any) -> None:
        """Episodes as ``arguments`` say, at the task's default settings but for those given."""
        self.task, self.arguments, self.static = task, arguments, static or task.default_static
        self.changes, self.settings = settings, task.default_settings(**settings)

    @property
    def about(self) -> Row:
        """What outcomes depend on, beside the planner."""
        names = ("split", "seed", "episodes")
        return self.changes | {name: getattr(self.arguments, name) for name in names}

    @cached_property
    def truth(self) -> Truth:
        """What is known of the episodes, as of `Task.truth`."""
        shared = {name: getattr(self.arguments, name) for name in ("episodes", "seed", "split")}
        threads = self.arguments.threads
        return find_truth(self.task, self.settings, static=self.static, num_threads=threads, **shared)

    @property
    def solvable(self) -> torch.Tensor:
        """Which episodes can be solved at all, ``(E,)`` bool."""
        return self.truth.solvable

    def planner(self, name: str, **parts: Any) -> Any:
        """The task's planner of that name on this setting's static planner, with some parts exchanged."""
        chunk, static_chunk = self.task.rows_at_once
        made = self.task.planner(name, self.static, chunk=chunk, static_chunk=static_chunk)
        return made.with_parts(**parts) if parts else made

    def play(self, planner: Any, name: str, sensor: Sensor | None = None) -> EpisodeOutcomes:
        """Outcomes of the episodes under ``planner``, whose targets are measured by ``sensor``; exactly for None."""
        arguments = self.arguments
        return run_episodes(
            planner,
            self.task,
            self.settings,
            self.truth,
            episodes=arguments.episodes,
            seed=arguments.seed,
            split=arguments.split,
            num_envs=arguments.num_envs,
            num_threads=arguments.threads,
            sensor=sensor,
            name=name,
        )


def success_of(outcomes: EpisodeOutcomes) -> Row:
    """How many of the solvable episodes are a success, which of them are lost, and what planning it took."""
    solvable = outcomes.solvable
    lost = (solvable & ~outcomes.success).nonzero().flatten().tolist()
    share = rate_entries("success_solvable", int(solvable.sum()) - len(lost), int(solvable.sum()))
    replans = outcomes.replans.double().mean().item()
    return {"solvable": int(solvable.sum()), **share, "replans": replans, "lost": lost}


def rate_entries(name: str, successes: int, trials: int) -> Row:
    """A rate and its 95 % interval as two entries of a row."""
    value, low, high = rate(successes, trials)
    return {name: value, f"{name}_ci": [low, high]}


def change_entries(before: Row, after: Row) -> Row:
    """Change of success from one row to another of the same episodes, both as of `success_of`.

    The episodes are paired, and only solvable ones count: the mean difference with its 95 % interval, and the p-value
    of McNemar's exact test that there is none.
    """
    missed = sorted({*before["lost"], *after["lost"]})
    rest = torch.ones(after["solvable"] - len(missed), dtype=torch.bool)

    def success(row: Row) -> torch.Tensor:
        return torch.cat([torch.tensor([episode not in row["lost"] for episode in missed], dtype=torch.bool), rest])

    pair = success(after), success(before)
    gain = paired_loss(*pair)
    return {"change": gain.value, "change_ci": [gain.low, gain.high], "change_p": mcnemar(*pair)}


def each(cases: Iterable[Any], what: str) -> Iterator[Any]:
    """The cases of a study one after the other, with a bar of progress on a terminal."""
    return iter(tqdm(cases, desc=what, unit="row", leave=False, disable=None))


@contextmanager
def measuring() -> Iterator[None]:
    """Torch on one thread and without gradients, as all studies measure."""
    with one_thread(), torch.no_grad():
        yield


def told(row: Mapping[str, Any]) -> str:
    """A row as a line of text."""
    shown = {name: value for name, value in row.items() if name not in NOT_PRINTED}
    return "  ".join(f"{name} {_short(value)}" for name, value in shown.items())


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_short, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{name}: {_short(entry)}' for name, entry in value.items())}}}"
    return str(value)


def _json(value: Any) -> Any:
    """``value`` as JSON has it: None for NaN, and paths as text."""
    if isinstance(value, float):
        return None if math.isnan(value) else value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [_json(entry) for entry in value]
    if isinstance(value, Mapping):
        return {name: _json(entry) for name, entry in value.items()}
    return value
