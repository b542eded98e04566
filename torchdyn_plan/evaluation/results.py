"""Outcomes of episodes, their summary, and the files that store them."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from torchdyn_plan.checks import check_finite
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.intervals import rate
from torchdyn_plan.files import check_writable_folder, write_json
from torchdyn_plan.schemas import Count, Least, check_content
from torchdyn_plan.tasks.task import Settings, Task
from torchdyn_plan.versions import library_versions, machine

NO_CAUSE = -1
"""Code of an episode that did not fail, or whose task names no causes."""
TRACK, TRACK_COUNTS = "track_", ("used", "restarts", "rejected")
"""Counts of a track under ``plan`` and in files, with the first of these as their prefix."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeOutcomes:
    """Outcomes of E episodes, in the order of their numbers; every tensor has shape ``(E,)``."""

    success: Tensor
    """Bool."""
    steps: Tensor
    """Control steps until the success, -1 for none, int64."""
    replans: Tensor
    """Number of plans, int64."""
    solvable: Tensor
    """Whether the episode can be solved at all, by the task's definition, bool."""
    flags: Mapping[str, Tensor] = field(default_factory=dict)
    """Further outcomes of the task, bool, by name."""
    evidence: Mapping[str, Tensor] = field(default_factory=dict)
    """Measurements from which the causes follow, and counts of the track, by name."""
    cause: Tensor
    """Index into ``causes`` of the cause of failure, int64; `NO_CAUSE` for none."""
    causes: tuple[str, ...] = ()
    """Names of the causes of failure."""
    seconds: float
    """Wall time of all the episodes [s]."""

    def __post_init__(self) -> None:
        episodes = self.episodes
        named = {"success": self.success, "steps": self.steps, "replans": self.replans, "solvable": self.solvable}
        for name, tensor in {**named, **self.flags, **self.evidence, "cause": self.cause}.items():
            if tuple(tensor.shape) != (episodes,) or not episodes:
                expected = f"(E,) = ({episodes or '>= 1'},)"
                raise InputError(f"outcomes.{name} must have shape {expected}, got {tuple(tensor.shape)}")
        for name, tensor in {"success": self.success, "solvable": self.solvable, **self.flags}.items():
            if tensor.dtype != torch.bool:
                raise InputError(f"outcomes.{name} must be bool, got {tensor.dtype}")

    @property
    def episodes(self) -> int:
        """Number of episodes E."""
        return self.success.numel()

    @property
    def track(self) -> dict[str, Tensor]:
        """Numbers of measurements counted by the planner's track; empty for a planner without a track.

        ``used`` since the track last lost its target, ``restarts`` of the motion by measurements that did not fit, and
        ``rejected`` measurements.
        """
        named = {name: self.evidence.get(f"{TRACK}{name}") for name in TRACK_COUNTS}
        return {name: count for name, count in named.items() if count is not None}

    def to_json(self, task: Task) -> dict[str, Any]:
        """Lists and numbers for a JSON file, with the task's names, including the cause of each failure."""
        counts = {"solvable": self.solvable, "steps": self.steps, "replans": self.replans}
        tensors = {task.words.success: self.success, **self.flags, **counts, **self.evidence}
        content: dict[str, Any] = {name: tensor.tolist() for name, tensor in tensors.items()}
        if self.causes:
            content["cause"] = [None if code == NO_CAUSE else self.causes[code] for code in self.cause.tolist()]
        return content | {"seconds": self.seconds}

    @classmethod
    def from_json(cls, content: Mapping[str, Any], task: Task) -> EpisodeOutcomes:
        """The outcomes that `to_json` wrote.

        A file does not distinguish boolean evidence from flags: both are read as flags.

        Raises:
            InputError: an entry is missing, is of another kind, or names a cause that ``task`` does not know.
        """
        own = {task.words.success: list[bool], **_ENTRIES}
        check_content(content, dict[str, Any], "episode outcomes")
        missing = sorted(set(own) - set(content))
        if missing:
            raise InputError(f"episode outcomes lack {', '.join(missing)}")
        for name, value in content.items():
            schema = own.get(name, _CAUSES if name == "cause" else _OTHERS)
            check_content(value, schema, "episode outcomes", entry=name)
        tensors = {name: torch.tensor(content[name]) for name in content if name not in {"cause", "seconds"}}
        others = {name: tensor for name, tensor in tensors.items() if name not in own}
        for name, tensor in others.items():
            # A finite number in a file may be too large for float32.
            check_finite(f"episode outcomes: {name}", tensor)
        return cls(
            success=tensors[task.words.success],
            steps=tensors["steps"],
            replans=tensors["replans"],
            solvable=tensors["solvable"],
            flags={name: tensor for name, tensor in others.items() if tensor.dtype == torch.bool},
            evidence={name: tensor for name, tensor in others.items() if tensor.dtype != torch.bool},
            cause=_codes(content.get("cause", [None] * len(content["steps"])), task.causes),
            causes=task.causes,
            seconds=float(content["seconds"]),
        )

    @classmethod
    def merge(cls, parts: Sequence[EpisodeOutcomes]) -> EpisodeOutcomes:
        """Concatenate outcomes as if they were one run; their times add up."""
        names = ("success", "steps", "replans", "solvable", "cause")
        first = parts[0]
        for part in parts:
            if part.flags.keys() != first.flags.keys() or part.evidence.keys() != first.evidence.keys():
                one, other = ([*part.flags, *part.evidence], [*first.flags, *first.evidence])
                raise InputError(f"outcomes of one run have {', '.join(one)}, those of another {', '.join(other)}")
        return cls(
            **{name: torch.cat([getattr(part, name) for part in parts]) for name in names},
            flags={name: torch.cat([part.flags[name] for part in parts]) for name in first.flags},
            evidence={name: torch.cat([part.evidence[name] for part in parts]) for name in first.evidence},
            causes=first.causes,
            seconds=sum(part.seconds for part in parts),
        )


_ENTRIES = {
    "steps": list[Annotated[int, Least(-1)]],
    "replans": list[Count],
    "solvable": list[bool],
    "seconds": Annotated[float, Least(0.0)],
}
_CAUSES = list[str | None]
_OTHERS = list[bool] | list[float]
"""Further entries of episode outcomes in a file: those of every task, flags and evidence."""


def _codes(names: Sequence[str | None], causes: Sequence[str]) -> Tensor:
    """Codes ``(E,)`` int64 of causes by name."""
    unknown = sorted({name for name in names if name is not None} - set(causes))
    if unknown:
        raise InputError(f"episode outcomes name unknown causes: {', '.join(unknown)}")
    return torch.tensor([NO_CAUSE if name is None else causes.index(name) for name in names])


@dataclass(frozen=True, kw_only=True)
class ResultRow:
    """One planner at one setting, as in ``results.json``. Rates are 0 to 1, ``_ci`` their 95 % Wilson intervals."""

    planner: str
    static: str
    task: str
    settings: dict[str, Any]
    """The task's settings by name."""
    episodes: int
    success: float
    """Share of all episodes that are a success."""
    success_ci: tuple[float, float]
    solvable: float
    """Share of all episodes that are solvable."""
    success_solvable: float | None
    """Share of the solvable episodes that are a success; None when there are none."""
    success_solvable_ci: tuple[float, float]
    steps_to_success: float | None
    """Mean control steps until the success; None when there was none."""
    replans: float
    """Mean number of re-plans an episode."""
    failures: dict[str, float]
    """Cause to share of all episodes; empty for a task that names none."""
    measures: dict[str, float | None]
    """The task's further figures, by name; empty for a task that has none."""
    episodes_per_second: float | None
    paper_success: float | None
    """The paper's success rate over all episodes at this setting; None where it has none."""
    paper_success_solvable: float | None
    """The paper's success rate over solvable episodes at this setting; None where it has none."""
    repeats: int = 1
    """Number of series of episodes in the row."""
    success_repeats: tuple[float, float] | None = None
    """Mean and standard deviation of ``success`` over the repeats of a sweep, as the paper reports; None for one."""
    success_solvable_repeats: tuple[float, float] | None = None
    """The same for ``success_solvable``; also None if a repeat has no solvable episode."""
    track: dict[str, float] = field(default_factory=dict)
    """Means per episode of the track's counts, see `EpisodeOutcomes.track`; empty for a planner without a track."""


def failure_shares(outcomes: EpisodeOutcomes) -> dict[str, float]:
    """Share of all episodes that failed from each cause, by name."""
    codes = outcomes.cause[outcomes.cause != NO_CAUSE]
    counts = torch.bincount(codes, minlength=len(outcomes.causes))
    return {name: count / outcomes.episodes for name, count in zip(outcomes.causes, counts.tolist(), strict=True)}


def summarize(outcomes: EpisodeOutcomes, *, task: Task, planner: str, static: str, settings: Settings) -> ResultRow:
    """Reduce the episodes of one planner at one setting to rates, means and causes of failure."""
    success, solvable = outcomes.success, outcomes.solvable
    everything = rate(int(success.sum()), outcomes.episodes)
    possible = rate(int((success & solvable).sum()), int(solvable.sum()))
    paper = _paper_rates(task, planner, static, settings)
    return ResultRow(
        planner=planner,
        static=static,
        task=task.name,
        settings=dataclasses.asdict(settings),
        episodes=outcomes.episodes,
        success=everything.value,
        success_ci=(everything.low, everything.high),
        solvable=solvable.double().mean().item(),
        success_solvable=possible.value if bool(solvable.any()) else None,
        success_solvable_ci=(possible.low, possible.high),
        steps_to_success=outcomes.steps[success].double().mean().item() if bool(success.any()) else None,
        replans=outcomes.replans.double().mean().item(),
        failures=failure_shares(outcomes),
        measures={} if task.measure is None else task.measure(outcomes),
        episodes_per_second=outcomes.episodes / outcomes.seconds if outcomes.seconds > 0 else None,
        paper_success=paper[0],
        paper_success_solvable=paper[1],
        track={name: count.double().mean().item() for name, count in outcomes.track.items()},
    )


def _paper_rates(task: Task, planner: str, static: str, settings: Settings) -> tuple[float | None, float | None]:
    """The paper's success rates over all and over solvable episodes."""
    if task.paper is None:
        return None, None
    paper = task.paper()
    everything = paper.rate(planner, static, settings, solvable=False)
    return everything, paper.rate(planner, static, settings, solvable=True)


def over_repeats(row: ResultRow, repeats: Sequence[EpisodeOutcomes]) -> ResultRow:
    """``row`` over all ``repeats``, with mean and standard deviation over them."""

    def spread(rates: Sequence[float]) -> tuple[float, float] | None:
        if len(rates) < 2 or not all(math.isfinite(one) for one in rates):
            return None
        return statistics.mean(rates), statistics.stdev(rates)

    everything = [float(one.success.double().mean()) for one in repeats]
    # Without a solvable episode the mean is NaN.
    possible = [float(one.success[one.solvable].double().mean()) for one in repeats]
    return dataclasses.replace(
        row,
        repeats=len(repeats),
        success_repeats=spread(everything),
        success_solvable_repeats=spread(possible),
    )


def write_results(
    folder: Path,
    task: Task,
    config: Mapping[str, Any],
    rows: Sequence[ResultRow],
    outcomes: Mapping[str, EpisodeOutcomes] | None = None,
) -> None:
    """Write ``results.json`` and, given the outcomes by planner, ``episodes.json`` into ``folder``.

    Raises:
        OutputError: the folder cannot be written to.
    """
    check_writable_folder(folder)
    if outcomes is not None:
        write_json(folder / "episodes.json", {name: episodes.to_json(task) for name, episodes in outcomes.items()})
    content = {
        "config": dict(config),
        "versions": library_versions(),
        "machine": machine(),
        "rows": [dataclasses.asdict(row) for row in rows],
    }
    write_json(folder / "results.json", content)
