"""Planners and the episodes they all run: the common part of an evaluation and a sweep."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase

from torchdyn_plan.checks import check_choice, check_count, check_threads
from torchdyn_plan.envs.episodes import FINAL
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.episodes import Planner, find_truth, run_episodes
from torchdyn_plan.evaluation.results import EpisodeOutcomes, ResultRow, summarize
from torchdyn_plan.planners import Delivery, DynamicPlanner, Track, TrackedPlanner
from torchdyn_plan.planners.pretrained import planner_digest
from torchdyn_plan.tasks.task import Settings, Task
from torchdyn_plan.threads import one_thread

SPLITS = ("test", "dev")
"""Families of series of episodes to evaluate on: tuning sees ``dev`` only."""

Planners = Mapping[str, Planner] | Sequence[str]
"""Planners by name, or names of a task's own."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """Planners by name, and the number and kind of episodes that each runs."""

    task: Task
    planners: Mapping[str, Planner]
    static: str
    """Name of the static planner that decides which episodes are solvable."""
    episodes: int = 100
    split: str = "test"
    num_envs: int = 64
    num_threads: int = 0
    delivery: Delivery | None = None
    sensor: Sensor | None = None
    """How targets are measured; exactly for None."""
    track: Track | None = None
    """Filter between sensor and planners; for None they see the newest measurement, held."""
    progress: bool = True

    def __post_init__(self) -> None:
        check_count("episodes", self.episodes)
        check_count("num_envs", self.num_envs)
        check_threads("num_threads", self.num_threads)
        check_open(self.split)

    @classmethod
    def of(
        cls,
        task: Task,
        planners: Planners | None = None,
        *,
        static: str | None = None,
        weights: str | Path | None = None,
        delivery: Delivery | None = None,
        other_scene: bool = False,
        **episodes: Any,
    ) -> Study:
        """The study of ``planners``, see `evaluate`; ``episodes`` are the other fields."""
        static = static or task.default_static
        check_choice(f"static planner of {task.name}", static, task.static_planners)
        # Fields are checked before weights are loaded.
        study = cls(task=task, planners={}, static=static, delivery=delivery, **episodes)
        if not isinstance(planners, Mapping):
            made = _make(task, planners, static, weights)
        elif weights is None:
            made = dict(planners)
        else:
            raise InputError("weights apply to planners given by name, but planner objects were given")
        if not made:
            raise InputError(f"planners must name at least one of {', '.join(task.planners)}")
        if study.track is not None:
            made = {name: _tracked(name, planner, study.track, task) for name, planner in made.items()}
        if not other_scene:
            _check_scenes(task, made)
        if delivery is not None:
            made = {name: _delivered(planner, delivery) for name, planner in made.items()}
        return dataclasses.replace(study, planners=made)

    def run(self, settings: Settings, seed: int) -> dict[str, EpisodeOutcomes]:
        """Outcomes of the same episodes for each planner."""
        shared: dict[str, Any] = {
            "episodes": self.episodes,
            "seed": seed,
            "split": self.split,
            "num_threads": self.num_threads,
        }
        with one_thread():
            truth = find_truth(self.task, settings, static=self.static, **shared)
            shared |= {"num_envs": self.num_envs, "progress": self.progress, "sensor": self.sensor}
            return {
                name: run_episodes(planner, self.task, settings, truth, name=name, **shared)
                for name, planner in self.planners.items()
            }

    def summarize(self, settings: Settings, outcomes: Mapping[str, EpisodeOutcomes]) -> list[ResultRow]:
        """A row for each planner."""
        shared: dict[str, Any] = {"task": self.task, "static": self.static, "settings": settings}
        return [summarize(outcome, planner=name, **shared) for name, outcome in outcomes.items()]

    def config(self) -> dict[str, Any]:
        """The configuration, for a file of results."""
        counts = {name: getattr(self, name) for name in ("episodes", "split", "num_envs", "num_threads")}
        delivery = None if self.delivery is None else repr(self.delivery)
        about = {"task": self.task.name, "planners": list(self.planners), "static": self.static}
        # Left out if absent, so that results from before sensors existed keep their configuration.
        sensor = {} if self.sensor is None or self.sensor.is_exact else {"sensor": self.sensor.told()}
        track = {} if self.track is None else {"track": self.track.told()}
        whole = {"delivery": delivery, "scene": self.task.digest(), "weights": dict(self.weights)}
        return about | counts | whole | sensor | track

    @cached_property
    def weights(self) -> Mapping[str, str | None]:
        """A short digest of each planner, including its networks' weights; None for a function."""
        return {name: planner_digest(planner) for name, planner in self.planners.items()}


def check_open(split: str) -> None:
    """Raise `InputError` unless ``split`` is one of `SPLITS`."""
    if split == FINAL:
        raise InputError(f"split {FINAL!r} is played once a release, by benchmarks/final.py alone; use test or dev")
    check_choice("split", split, SPLITS)


def _make(task: Task, names: Sequence[str] | None, static: str, weights: str | Path | None) -> dict[str, Planner]:
    """The task's planners of these names, its default ones for None."""
    names = task.default_planners if names is None else (names,) if isinstance(names, str) else names
    for name in names:
        check_choice(f"planner of {task.name}", name, task.planners)
    if len(set(names)) < len(names):
        raise InputError(f"planners must be named once each, got {' '.join(names)}")
    chunk, static_chunk = task.rows_at_once
    sizes: dict[str, Any] = {"chunk": chunk, "static_chunk": static_chunk}
    with one_thread():
        return {name: task.planner(name, static, weights=weights, **sizes) for name in names}


def _check_scenes(task: Task, planners: Mapping[str, Planner]) -> None:
    """Raise `InputError` if a planner belongs to another scene; plain functions belong to none."""
    here = task.digest()
    for name, planner in planners.items():
        scene = getattr(planner, "scene", None)
        if scene not in (None, here):
            raise InputError(
                f"planner {name!r} belongs to another scene ({scene}) than {task.name} ({here}): "
                "give other_scene=True to evaluate it anyway"
            )


def _tracked(name: str, planner: Planner, track: Track, task: Task) -> TrackedPlanner:
    """``planner`` behind ``track``; raises `InputError` for one that has a track, or cannot have one."""
    if isinstance(planner, TrackedPlanner):
        raise InputError(f"planner {name!r} already has a track: give the planner without it, or give no other track")
    if not isinstance(planner, TensorDictModuleBase):
        raise InputError(f"planner {name!r} is not a planner of this package, and cannot have a track")
    return TrackedPlanner(planner, track, control_step=task.control_step)


def _delivered(planner: Planner, delivery: Delivery) -> Planner:
    """The planner with ``delivery``; a planner without plans is returned unchanged."""
    if isinstance(planner, TrackedPlanner):
        return planner.with_planner(_delivered(planner.planner, delivery))
    return planner.with_parts(delivery=delivery) if isinstance(planner, DynamicPlanner) else planner
