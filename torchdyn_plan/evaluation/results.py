"""From episodes to numbers: outcomes, their summary, and the files that hold them."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdyn_plan.checks import check_writable_folder
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.evidence import Evidence
from torchdyn_plan.evaluation.failures import CAUSES, SUCCESS, failure_cause, failure_shares
from torchdyn_plan.evaluation.intervals import rate
from torchdyn_plan.evaluation.paper import paper_rate_at
from torchdyn_plan.files import write_json
from torchdyn_plan.versions import library_versions, machine

_FLAGS = ("trapped", "touched", "pocketed", "solvable")
_COUNTS = ("steps", "replans")
_CLUES = Evidence._fields


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeOutcomes:
    """How each of E episodes ended, in the order of their numbers; every tensor has shape ``(E,)``."""

    trapped: Tensor
    """The ball was covered and kept, bool."""
    steps: Tensor
    """Control steps until it was trapped, -1 where it was not, int64."""
    replans: Tensor
    """How often the planner chose a goal, int64."""
    touched: Tensor
    """The ball bounced off the outside of the box, bool."""
    pocketed: Tensor
    """The ball fell into a pocket, bool."""
    solvable: Tensor
    """The static planner could have been at some future place of the ball in time (paper, Section IV-B), bool."""
    seconds: float
    """Wall time of all the episodes [s]."""
    evidence: Evidence = None  # pyright: ignore[reportAssignmentType]
    """What decides the cause of a failure; by default that of episodes of which nothing was recorded."""

    def __post_init__(self) -> None:
        if self.evidence is None:
            object.__setattr__(self, "evidence", Evidence.none(self.episodes))
        for name, tensor in self._tensors().items():
            shape = tuple(tensor.shape)
            if shape != (self.episodes,) or not self.episodes:
                raise InputError(f"outcomes.{name} must have shape (E,) = ({self.episodes or '>= 1'},), got {shape}")
        for name in _FLAGS:
            if getattr(self, name).dtype != torch.bool:
                raise InputError(f"outcomes.{name} must be bool, got {getattr(self, name).dtype}")

    @property
    def episodes(self) -> int:
        """Number of episodes E."""
        return self.trapped.numel()

    @property
    def cause(self) -> Tensor:
        """Code of what each episode failed of, as of `failure_cause`, ``(E,)`` int64."""
        return failure_cause(self.trapped, self.solvable, self.touched, self.pocketed, self.evidence)

    def _tensors(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name in (*_FLAGS, *_COUNTS)} | self.evidence._asdict()

    def to_json(self) -> dict[str, Any]:
        """Lists and numbers for a JSON file, the cause of each failure among them."""
        names = [None if code == SUCCESS else CAUSES[code] for code in self.cause.tolist()]
        tensors = {name: tensor.tolist() for name, tensor in self._tensors().items()}
        return tensors | {"cause": names, "seconds": self.seconds}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "EpisodeOutcomes":
        """The outcomes that `to_json` wrote, or wrote before there was evidence.

        Raises:
            InputError: an entry is missing.
        """
        missing = sorted({*_FLAGS, *_COUNTS, "seconds"} - set(content))
        if missing:
            raise InputError(f"episode outcomes lack {', '.join(missing)}")
        flags = {name: torch.tensor(content[name], dtype=torch.bool) for name in _FLAGS}
        counts = {name: torch.tensor(content[name], dtype=torch.int64) for name in _COUNTS}
        clues = Evidence.none(len(flags["trapped"]))
        if set(_CLUES) <= set(content):
            clues = Evidence(*(torch.tensor(content[name]).to(clue.dtype) for name, clue in clues._asdict().items()))
        return cls(**flags, **counts, seconds=float(content["seconds"]), evidence=clues)

    @classmethod
    def merge(cls, parts: Sequence["EpisodeOutcomes"]) -> "EpisodeOutcomes":
        """One after the other, as if they had been one run; their times add up."""
        tensors = {name: torch.cat([getattr(part, name) for part in parts]) for name in (*_FLAGS, *_COUNTS)}
        evidence = Evidence(*(torch.cat(clues) for clues in zip(*(part.evidence for part in parts), strict=True)))
        return cls(**tensors, seconds=sum(part.seconds for part in parts), evidence=evidence)


@dataclass(frozen=True, kw_only=True)
class ResultRow:
    """One planner at one setting, as in ``results.json``. Rates are 0 to 1, ``_ci`` their 95 % Wilson intervals."""

    planner: str
    static: str
    task: str
    velocity: float
    """Velocity of the ball at the start [m/s]."""
    friction: float
    """Friction loss of the ball."""
    episodes: int
    success: float
    """Share of all episodes that end with the ball trapped."""
    success_ci: tuple[float, float]
    solvable: float
    """Share of all episodes that are solvable."""
    success_solvable: float | None
    """Share of the solvable episodes that end with the ball trapped; None when there are none."""
    success_solvable_ci: tuple[float, float]
    steps_to_trap: float | None
    """Mean control steps until the ball was trapped; None when it never was."""
    replans: float
    """Mean number of re-plans an episode."""
    failures: dict[str, float]
    """Cause to share of all episodes."""
    episodes_per_second: float | None
    paper_success: float | None
    """The paper's success rate over all episodes at this setting; None where it has none."""
    paper_success_solvable: float | None
    """The paper's success rate over solvable episodes at this setting; None where it has none."""
    motion: str = "straight"
    """How the goal of Reach moves."""


def summarize(
    outcomes: EpisodeOutcomes,
    *,
    planner: str,
    static: str,
    velocity: float,
    friction: float,
    task: str = "trapper",
    motion: str = "straight",
) -> ResultRow:
    """Reduce the episodes of one planner at one setting to rates, means and causes of failure."""
    paper = partial(paper_rate_at, planner, static, velocity, friction, task=task, motion=motion)
    trapped, solvable = outcomes.trapped, outcomes.solvable
    everything = rate(int(trapped.sum()), outcomes.episodes)
    possible = rate(int((trapped & solvable).sum()), int(solvable.sum()))
    return ResultRow(
        planner=planner,
        static=static,
        task=task,
        velocity=velocity,
        friction=friction,
        episodes=outcomes.episodes,
        success=everything.value,
        success_ci=(everything.low, everything.high),
        solvable=solvable.double().mean().item(),
        success_solvable=possible.value if bool(solvable.any()) else None,
        success_solvable_ci=(possible.low, possible.high),
        steps_to_trap=outcomes.steps[trapped].double().mean().item() if bool(trapped.any()) else None,
        replans=outcomes.replans.double().mean().item(),
        failures=failure_shares(outcomes.cause),
        episodes_per_second=outcomes.episodes / outcomes.seconds if outcomes.seconds > 0 else None,
        paper_success=paper(solvable=False),
        paper_success_solvable=paper(solvable=True),
        motion=motion,
    )


def write_results(
    folder: Path,
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
        write_json(folder / "episodes.json", {name: episodes.to_json() for name, episodes in outcomes.items()})
    content = {
        "config": dict(config),
        "versions": library_versions(),
        "machine": machine(),
        "rows": [dataclasses.asdict(row) for row in rows],
    }
    write_json(folder / "results.json", content)
