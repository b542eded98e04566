"""A task in one frozen object: everything that differs from task to task.

Nothing heavy is imported here or in the modules that define tasks: what a task needs is imported where it is used, so
that the command line can ask a task for its options at once.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from torchdyn_plan.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchdyn_plan.envs.moving_target import MovingTargetEnv
    from torchdyn_plan.evaluation.curves import PaperMoments, PaperPanel

NOISY = "noisy_"
"""Name prefix of networks for noisy measurements, seen through a track."""
NEAREST_ETA = "nearest_eta"
"""Network of the times until the robot is as near to a goal as it can come, and the end of its weights' name."""
ENTRY_POINTS = "torchdyn_plan.tasks"
"""Group of entry points in which other packages name their tasks, ``name = "package.module:NAME"``."""


def setting(
    default: Any,
    *,
    text: str,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[Any] = (),
    sweep: Sequence[float] = (),
) -> Any:
    """A field of a task's settings.

    Args:
        default: value that is taken when none is given.
        text: one line for ``--help``, without the unit.
        unit: of the value.
        minimum: least value allowed; None for any.
        maximum: greatest value allowed; None for any.
        choices: the only values allowed; empty for any.
        sweep: values of a sweep over this setting; empty for a setting that is not swept.
    """
    about = {"text": text, "unit": unit, "minimum": minimum, "maximum": maximum}
    return field(default=default, metadata=about | {"choices": tuple(choices), "sweep": tuple(sweep)})


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a task that vary from run to run; a task defines a frozen subclass with fields made by `setting`."""

    def __post_init__(self) -> None:
        from torchdyn_plan.checks import check_choice, check_number

        for one in dataclasses.fields(self):
            value, about = getattr(self, one.name), one.metadata
            if about.get("choices"):
                check_choice(one.name, value, about["choices"])
            elif isinstance(value, (int, float)) and not isinstance(value, bool):
                bounds = {name: about[name] for name in ("minimum", "maximum") if about.get(name) is not None}
                check_number(one.name, value, **bounds)


class Words(NamedTuple):
    """Names of a task's outcomes in files and tables."""

    success: str
    """Flag of the environment that marks a success, such as ``trapped``."""
    steps: str
    """Name of the time to a success, such as ``steps to trap``."""
    target: str = "target"
    """What moves, such as ``ball``."""


class Truth(NamedTuple):
    """What is known about E episodes before a planner runs them."""

    future: Tensor
    """``(E, T, D)`` positions of the targets at steps 0 … T-1, had no robot touched them [m, world]."""
    solvable: Tensor
    """``(E,)`` bool: episodes that can be solved at all, by the task's notion of it."""


class Verdict(NamedTuple):
    """A task's assessment of E episodes, ``(E,)`` each."""

    cause: Tensor
    """int64 index into `Task.causes` of the cause of failure; -1 for a success."""
    flags: Mapping[str, Tensor]
    """Further outcomes, bool, by name."""
    evidence: Mapping[str, Tensor]
    """Measurements from which the causes follow, by name."""


class PaperCurves(Protocol):
    """Success rates that a paper reports for a task, for comparison with ours."""

    def rate(self, planner: str, static: str, settings: Any, *, solvable: bool) -> float | None:
        """The paper's success rate at these settings, over all or over solvable episodes; None where it has none."""
        ...

    def curve(
        self, planner: str, static: str, over: str, settings: Any, *, solvable: bool
    ) -> tuple[list[float], list[float]] | None:
        """The paper's curve over the setting ``over``, the others as in ``settings``: abscissae and success rates."""
        ...

    def panels(self) -> Sequence[PaperPanel | PaperMoments]:
        """The diagrams of the paper's figures, which ``torchdyn-plan report`` draws with our results in them."""
        ...


@dataclass(frozen=True, kw_only=True)
class PolicyTraining:
    """How a policy of a task is trained by trial."""

    summary: str
    """One line for ``--help``."""
    options: type[Any]
    """Frozen dataclass of its options, each documented by a line of text below it; all have defaults."""
    goal_task: Callable[..., Any]
    """Makes the `torchdyn_plan.training.goal_task.GoalTask` from those options and ``num_threads``."""
    recipe: Callable[[], Any]
    """Makes the `torchdyn_plan.training.goal_task.DDPGRecipe` that is taken when nothing else is asked for."""
    score_every: int = 20
    """Rounds from one score to the next."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A robot, a moving target, and what counts as meeting it.

    Every callable imports what it needs when it is called. ``settings`` below is an instance of the task's settings.
    """

    name: str
    """Name on the command line and in the names of weights."""
    summary: str
    """One line for ``--help``."""
    settings: type[Settings]
    """Settings that vary from run to run."""
    words: Words
    """Names of its outcomes in files and tables."""
    max_steps: int
    """Control steps of an episode at most."""
    control_step: float
    """Time between two actions [s]."""
    make_env: Callable[..., MovingTargetEnv]
    """``(settings, *, num_envs, seed, split, num_threads)`` to the environment; and ``sensor`` where there is one."""
    digest: Callable[[], str]
    """Hash of the scene. Data, weights and planners belong to the scene with their hash."""
    static_planners: Mapping[str, Callable[..., Any]]
    """Makers of static planners by name, ``(*, chunk, weights)``: rows that it sees at once, None for all of them at a
    time, and file or folder of a policy's weights, None for those that ship. The first is taken when none is named."""
    planners: Mapping[str, Callable[[PlannerParts], Any]]
    """Makers of planners for the moving target by name, from the parts that they may need."""
    scene: Any = ""
    """Its scene, by the name in ``scenes`` or itself, if there are several."""
    scenes: Mapping[str, Callable[[], Task]] = field(default_factory=dict)
    """The same task in each of its scenes, by the scene's name; the first is the one that its name alone stands for."""
    path_weights: str = ""
    """What the weights that ship of networks of the target's motion are called, if targets move alike in several
    scenes; `weights_name` if it is empty."""
    rivals: tuple[str, ...] = ()
    """Planners that run only if named."""
    rows_at_once: tuple[int, int] = (32, 64)
    """Rows that networks and static planners see at once in an evaluation, so that its results do not depend on how
    many environments run side by side."""
    truth: Callable[..., Truth] | None = None
    """``(settings, *, episodes, seed, split, static, num_threads)`` to what is known beforehand of episodes 0 … E-1,
    with the static planner of that name; None if nothing is: then all episodes count as solvable."""
    causes: tuple[str, ...] = ()
    """Names of the causes of failure, in the order in which they are asked."""
    judge: Callable[..., Verdict] | None = None
    """``(settings, log, truth)``, with the `torchdyn_plan.evaluation.episodes.EpisodeLog`, to why episodes failed."""
    measure: Callable[[Any], dict[str, float | None]] | None = None
    """The `torchdyn_plan.evaluation.results.EpisodeOutcomes` to further figures of them, by name; None of a figure that
    they do not tell."""
    record_paths: Callable[..., dict[str, Tensor]] | None = None
    """``(blocks, *, seed, num_threads)`` to the paths of targets that nobody touches, of the episodes in ``blocks``
    (tensors of their numbers), laid end to end: ``positions start length pocketed velocity``."""
    record_arrivals: Callable[..., dict[str, Tensor]] | None = None
    """``(planner, *, num_envs, sequences, seed, num_threads)`` to runs of a static planner: ``robot_state goal arrival
    nearest run``; None if no arrival model is trained."""
    record_captures: Callable[..., dict[str, Tensor]] | None = None
    """``(static, blocks, *, seed, num_threads)`` to attempts of a planner on the static planner of that name, in the
    episodes in ``blocks``, and what came of them: ``window goal captured run``; None if no capture model is trained."""
    fitting: Callable[[], Any] | None = None
    """Makes the `torchdyn_plan.training.fitting.Fitting`: sizes of networks, and how they are scored."""
    policies: Mapping[str, PolicyTraining] = field(default_factory=dict)
    """Policies that can be trained, by the name of their weights."""
    paper: Callable[[], PaperCurves] | None = None
    """Makes the curves of the paper; None if no paper has any."""

    @property
    def default_static(self) -> str:
        """Name of the static planner that is taken when none is named."""
        return next(iter(self.static_planners))

    @property
    def default_planners(self) -> tuple[str, ...]:
        """Planners that run when none are named."""
        return tuple(name for name in self.planners if name not in self.rivals)

    @property
    def weights_name(self) -> str:
        """What its weights that ship are called: its name, and its scene unless that is the first."""
        if self.scene == next(iter(self.scenes), ""):
            return self.name
        return f"{self.name}-{self.scene if self.scene in self.scenes else self.digest()}"

    def in_scene(self, scene: str) -> Task:
        """The same task in the scene of that name; raises `InputError` if there is none."""
        from torchdyn_plan.checks import check_choice

        if not self.scenes:
            raise InputError(f"{self.name} has one scene alone, got {scene!r}")
        check_choice(f"scene of {self.name}", scene, self.scenes)
        return self.scenes[scene]()

    def static_planner(self, name: str | None = None, *, chunk: int | None = None, weights: Any = None) -> Any:
        """The static planner of that name, the default one for None; raises `InputError`, or `WeightsError`."""
        from torchdyn_plan.checks import check_choice

        name = name or self.default_static
        check_choice(f"static planner of {self.name}", name, self.static_planners)
        return self.static_planners[name](chunk=chunk, weights=weights)

    def planner(
        self,
        name: str,
        static: str | None = None,
        *,
        weights: str | Path | None = None,
        chunk: int | None = None,
        static_chunk: int | None = None,
    ) -> Any:
        """A planner for the moving target.

        Args:
            name: one of `planners`.
            static: name of its static planner; the default one for None.
            weights: folder of its networks, as ``train`` leaves it; those that ship for None.
            chunk: rows that its networks see at once, so that results do not depend on the batch size.
            static_chunk: rows that its static planner sees at once.

        Raises:
            InputError: the task has no such planner; the message lists those it has.
            WeightsError: weights are missing or damaged.
        """
        from torchdyn_plan.checks import check_choice

        check_choice(f"planner of {self.name}", name, self.planners)
        static = static or self.default_static
        check_choice(f"static planner of {self.name}", static, self.static_planners)
        folder = None if weights is None else Path(weights)
        return self.planners[name](PlannerParts(self, static, folder, chunk, static_chunk))

    def default_settings(self, **changes: Any) -> Settings:
        """The task's settings with some of them changed; raises `InputError` for an unknown name or a bad value."""
        from torchdyn_plan.checks import check_choice

        for name in changes:
            check_choice(f"setting of {self.name}", name, [one.name for one in dataclasses.fields(self.settings)])
        return self.settings(**changes)


@dataclass(frozen=True)
class PlannerParts:
    """What a task's planners are made of; networks are loaded when they are asked for."""

    task: Task
    static_name: str
    weights: Path | None = None
    """Folder of the networks; None for those that ship."""
    chunk: int | None = None
    static_chunk: int | None = None

    @property
    def static(self) -> Any:
        """The static planner."""
        return self.task.static_planner(self.static_name, chunk=self.static_chunk)

    @property
    def forecaster(self) -> Any:
        """The `Forecaster`, frozen."""
        from torchdyn_plan.nets import Forecaster

        return self._load(Forecaster, self._path_weights)

    @property
    def spread_forecaster(self) -> Any:
        """The `Forecaster` with its `SpreadNetwork`, frozen."""
        from torchdyn_plan.nets import SpreadForecaster, SpreadNetwork

        return SpreadForecaster(self.forecaster, self._load(SpreadNetwork, self._path_weights)).eval()

    @property
    def forecaster_by_noise(self) -> Any:
        """`spread_forecaster`, together with the one for noisy measurements if there is one."""
        from torchdyn_plan.nets import ForecastByNoise, Forecaster, SpreadForecaster, SpreadNetwork

        forecaster, spread = self._noisy(Forecaster), self._noisy(SpreadNetwork)
        if forecaster is None or spread is None:
            return self.spread_forecaster
        return ForecastByNoise(self.spread_forecaster, SpreadForecaster(forecaster, spread)).eval()

    @property
    def path_by_noise(self) -> Any:
        """`forecaster`, together with the one for noisy measurements if there is one: paths without a spread."""
        from torchdyn_plan.nets import ForecastByNoise, Forecaster

        noisy = self._noisy(Forecaster)
        return self.forecaster if noisy is None else ForecastByNoise(self.forecaster, noisy).eval()

    @property
    def eta(self) -> Any:
        """The `ETANetwork` of the static planner, frozen."""
        from torchdyn_plan.nets import ETANetwork

        return self._load(ETANetwork, f"{self.task.weights_name}-{self.static_name}")

    @property
    def nearest_eta(self) -> Any:
        """The `ETANetwork` of the static planner that knows no *never*, as the paper's, frozen."""
        from torchdyn_plan.nets import ETANetwork

        if self.weights is None:
            return self._load(ETANetwork, f"{self.task.weights_name}-{self.static_name}-nearest")
        return ETANetwork.from_pretrained(self.weights / NEAREST_ETA).requires_grad_(False)

    @property
    def capture(self) -> Any:
        """The `CaptureNetwork` of the static planner, frozen; None if none ships, or is in the folder."""
        from torchdyn_plan.errors import WeightsError
        from torchdyn_plan.nets import CaptureNetwork

        name = f"{self.task.weights_name}-{self.static_name}"
        try:
            CaptureNetwork.find(name if self.weights is None else self.weights)
        except WeightsError:
            return None
        return self._load(CaptureNetwork, name)

    @property
    def _path_weights(self) -> str:
        return self.task.path_weights or self.task.weights_name

    def _noisy(self, kind: Any) -> Any:
        """The network of that kind for noisy measurements, frozen; None if the folder has none."""
        name: Any = f"{self._path_weights}-noisy"
        if self.weights is not None:
            name = self.weights / f"{NOISY}{kind.kind}"
            if not name.is_dir():
                return None
        return kind.from_pretrained(name).requires_grad_(False)

    def _load(self, kind: Any, name: str) -> Any:
        return kind.from_pretrained(name if self.weights is None else self.weights).requires_grad_(False)


_registered: dict[str, Task] = {}


def register(task: Task) -> Task:
    """Make ``task`` known by its name in this process; returns it. The last one of a name counts."""
    _registered[task.name] = task
    return task


def task_names() -> list[str]:
    """Names of the tasks that are registered, ship with the package, or are named by other packages' entry points."""
    package = importlib.import_module("torchdyn_plan.tasks")
    shipped = [module.name for module in pkgutil.iter_modules(package.__path__) if module.ispkg]
    others = [point.name for point in importlib.metadata.entry_points(group=ENTRY_POINTS)]
    return sorted({*_registered, *shipped, *others})


def load_task(name: str | Task, scene: str | None = None) -> Task:
    """The task of that name, or at ``package.module:NAME`` if it is nowhere registered; a `Task` is returned as it is.

    ``scene`` is the name of one of its scenes, as `Task.in_scene` takes it; None for the task's default scene.

    Raises:
        InputError: there is no such task or scene; the message lists those there are.
    """
    task = _find_task(name)
    return task if scene is None else task.in_scene(scene)


def _find_task(name: str | Task) -> Task:
    if isinstance(name, Task):
        return name
    if name in _registered:
        return _registered[name]
    if ":" in name:
        return _import_task(name)
    for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
        if point.name == name:
            return _import_task(point.value)
    if name in task_names():
        return _import_task(f"torchdyn_plan.tasks.{name}:TASK")
    from difflib import get_close_matches

    near = get_close_matches(name, task_names(), n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    raise InputError(f"unknown task {name!r}{hint}; choose from {', '.join(task_names())}, or give package.module:NAME")


def import_place(place: str, what: str) -> Any:
    """The object at ``place``, ``package.module:NAME``; the working folder is looked at, too.

    Raises:
        InputError: it cannot be imported, and is no ``what`` therefore.
    """
    module, _, attribute = place.partition(":")
    if str(Path.cwd()) not in sys.path and "" not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"no {what} at {place!r}: {error}") from error


def import_planner(place: str) -> Any:
    """The planner at ``place``, ``package.module:NAME``, or what the function there makes of nothing.

    Raises:
        InputError: there is none.
    """
    found = import_place(place, "planner")
    is_maker = inspect.isfunction(found) and not inspect.signature(found).parameters
    made = found() if is_maker else found
    if isinstance(made, type) or not callable(made):
        kind = f"the class {made.__name__}" if isinstance(made, type) else type(made).__name__
        raise InputError(f"a planner takes and returns a tensordict, but {place!r} is {kind}")
    return made


def _import_task(place: str) -> Task:
    """The task at ``package.module:NAME``."""
    found = import_place(place, "task")
    if not isinstance(found, Task):
        raise InputError(f"{place!r} is no Task, but {type(found).__name__}")
    return found
