"""Where the points of a sweep are run: in this process, or by workers of a Ray cluster."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

from torchdyn_plan.checks import check_choice, check_count
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.results import EpisodeOutcomes
from torchdyn_plan.evaluation.study import Study
from torchdyn_plan.tasks.task import Settings

ENGINES = ("here", "ray")


class Job(NamedTuple):
    """One point of a study."""

    settings: Settings
    seed: int


Key = tuple[float, int]
"""By which a job is known."""
Outcomes = Mapping[str, EpisodeOutcomes]
"""Of one job, by planner."""
Engine = Callable[[Study, Mapping[Key, Job]], Iterator[tuple[Key, Outcomes]]]
"""Runs jobs; their outcomes come as they are there."""


def find_engine(name: str, workers: int | None = None) -> Engine:
    """The engine ``name`` of `ENGINES`, with so many Ray workers, or one for each processor of the cluster for None.

    Raises:
        InputError: there is no such engine, it has no workers, or Ray is not installed.
    """
    check_choice("engine", name, ENGINES)
    if name == "here":
        if workers is not None:
            raise InputError("workers are those of engine 'ray', got engine 'here'")
        return run_here
    if workers is not None:
        check_count("workers", workers, maximum=10_000)
    if find_spec("ray") is None:
        raise InputError("engine 'ray' needs Ray: pip install 'torchdyn-plan[ray]'")
    return partial(run_on_ray, workers=workers)


def run_here(study: Study, jobs: Mapping[Key, Job]) -> Iterator[tuple[Key, Outcomes]]:
    """Run ``jobs`` in this process, one after the other."""
    for key, job in jobs.items():
        yield key, study.run(job.settings, job.seed)


def run_on_ray(study: Study, jobs: Mapping[Key, Job], *, workers: int | None) -> Iterator[tuple[Key, Outcomes]]:
    """Run ``jobs`` in Ray workers of one thread each; outcomes are those of `run_here`, but for the time they took.

    The workers belong to the cluster to which this process is connected by `ray.init`; else to one on this machine
    that ends with the jobs.
    """
    if not jobs:
        return
    ray: Any = importlib.import_module("ray")
    own = not ray.is_initialized()
    if own:
        ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False)
    try:
        # Progress bars of many workers would write over one another.
        shared = ray.put(dataclasses.replace(study, progress=False, num_threads=1))
        remote: Any = ray.remote(_run)
        waiting = {remote.remote(shared, job): key for key, job in jobs.items()}
        while waiting:
            for reference in ray.wait(list(waiting))[0]:
                yield waiting.pop(reference), ray.get(reference)
    finally:
        if own:
            ray.shutdown()


def _run(study: Study, job: Job) -> Outcomes:
    return study.run(job.settings, job.seed)
