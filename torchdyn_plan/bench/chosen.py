"""Selection of the planners to time: given, named, or found in a folder or a module; and the task of each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from torchdyn_plan import keys
from torchdyn_plan.checks import check_choice
from torchdyn_plan.errors import InputError, TorchdynPlanError
from torchdyn_plan.evaluation.episodes import Planner
from torchdyn_plan.planners import DynamicPlanner, ExactSearch, shipped_planners
from torchdyn_plan.tasks import DEFAULT, Task, import_planner, load_task, task_names

COARSE = 4
"""Coarseness of the exact searches that are also timed from coarse to fine."""
ONE = "planner"
"""Name of a planner that was given without one."""

Choice = Planner | Mapping[str, Planner] | Sequence[str] | str
"""A planner, planners by name, or names."""


class Chosen(NamedTuple):
    """A planner that is timed."""

    planner: Planner
    task: Task
    """The task in whose environment it acts."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Source of planners given by name."""

    task: Task | None = None
    """The task in which all planners act; None for the task of each planner's scene."""
    static: str | None = None
    """Static planner on which the task's planners are built; None for the default one."""
    weights: str | Path | None = None
    """Folder of the networks of the task's planners; None for the shipped ones."""

    @property
    def home(self) -> Task:
        """The task of planners given by bare names, and of planners without a scene."""
        return self.task or load_task(DEFAULT)

    def choose(self, planner: Choice | None) -> dict[str, Chosen]:
        """The planners by name, the task's default ones for None; raises `InputError`, or `WeightsError`."""
        if planner is None:
            return {name: Chosen(one, self.home) for name, one in self._defaults().items()}
        if isinstance(planner, Task):
            raise InputError(f"a planner is wanted, got the task {planner.name}: give it as task={planner.name!r}")
        return {name: Chosen(one, self._task_of(one)) for name, one in self._given(planner).items()}

    def _given(self, planner: Choice) -> dict[str, Planner]:
        """The planners by name."""
        if isinstance(planner, str | Path):
            planner = [str(planner)]
        if isinstance(planner, Mapping):
            found = dict(planner)
        elif isinstance(planner, Sequence):
            if len(set(map(str, planner))) < len(planner):
                raise InputError(f"planners must be named once each, got {' '.join(map(str, planner))}")
            found = {str(name): self._find(name) for name in planner}
        else:
            found = {ONE: planner}
        if not found:
            raise InputError("name at least one planner, got none")
        for name, one in found.items():
            if isinstance(one, type) or not callable(one):
                kind = f"the class {one.__name__}" if isinstance(one, type) else type(one).__name__
                raise InputError(f"a planner takes and returns a tensordict, but {name!r} is {kind}")
        return found

    def _find(self, name: Any) -> Planner:
        """The planner of that name: the task's, a shipped one, in a folder, or at ``package.module:NAME``."""
        if not isinstance(name, str | Path):
            raise InputError(f"planners must be names, or a mapping of names to planners, got {type(name).__name__}")
        name, task = str(name), self.home
        if name in task.planners:
            return task.planner(name, self.static, weights=self.weights)
        if name in task.static_planners:
            return task.static_planner(name)
        if not Path(name).is_dir():
            if ":" in name:
                return import_planner(name)
            check_choice(f"planner of {task.name}", name, {*task.planners, *task.static_planners, *shipped_planners()})
        return DynamicPlanner.from_pretrained(name)

    def _defaults(self) -> dict[str, Planner]:
        """The task's default planners that make plans, and exact searches from coarse to fine."""
        task, found = self.home, {}
        for name in task.default_planners:
            planner = task.planner(name, self.static, weights=self.weights)
            if not isinstance(planner, DynamicPlanner) or keys.TRUTHS & set(planner.in_keys):
                continue
            found[name] = planner
            search = planner.search
            if isinstance(search, ExactSearch) and search.coarse == 1 and search.probability_weight == 0.0:
                found[f"{name}, coarse to fine"] = planner.with_parts(search=replace(search, coarse=COARSE))
        if not found:
            raise InputError(f"no default planner of {task.name} makes plans: name one")
        return found

    def _task_of(self, planner: Planner) -> Task:
        """The requested task, else the task of the planner's scene, else the default one."""
        scene = getattr(planner, "scene", None)
        if self.task is not None or scene in (None, self.home.digest()):
            return self.home
        return next((task for task in _tasks_in_all_scenes() if _scene_of(task) == scene), self.home)


def _tasks_in_all_scenes() -> Iterator[Task]:
    """Every registered task, in each of its scenes."""
    for name in task_names():
        try:
            task = load_task(name)
        except (ImportError, TorchdynPlanError):
            continue
        yield from [task.in_scene(scene) for scene in task.scenes] or [task]


def _scene_of(task: Task) -> str | None:
    """Hash of the scene of ``task``; None if a library it needs is not installed."""
    try:
        return task.digest()
    except (ImportError, TorchdynPlanError):
        return None
