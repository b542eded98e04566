"""Arguments made for a task, from which the parser makes options. Nothing heavy is imported: help answers at once."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from torchdyn_plan.cli.arguments import (
    Arguments,
    CollectArguments,
    EnvArguments,
    EpisodeArguments,
    EvaluateArguments,
    FilmArguments,
    FitArguments,
    KinematicsArguments,
    PlannerArguments,
    PolicyArguments,
    RecordArguments,
    ReplanArguments,
    ReportArguments,
    SeriesArguments,
    SweepArguments,
    TrackArguments,
    ViewArguments,
)
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import InputError
from torchdyn_plan.tasks import DEFAULT, Task, task_names

FITTED = {
    "forecaster": "Fit the forecaster to paths of the target.",
    "spread": "Fit how far the forecaster is off, to paths of the target.",
    "noisy_forecaster": "Like forecaster, for noisy measurements seen through a track.",
    "noisy_spread": "Fit how far that one is off.",
    "eta": "Fit the network of arrival times to runs of a static planner.",
    "capture": "Fit the network of captures to attempts of the best planner.",
    "nearest_eta": "The same as the paper has it: times until the robot is as near as it can come, and no *never*.",
}
"""Networks that are fitted to data, and what ``--help`` says of them."""

TRACKS = ("none", "least_squares", "kalman", "ballistic")
"""Tracks by name; tests hold them against `torchdyn_plan.evaluation.tracks`, which takes long to import."""
ENGINES = ("here", "ray")
"""What runs a sweep; tests hold them against `torchdyn_plan.evaluation.engines`, which takes long to import."""
LAYERS = ("region", "trail", "forecast", "candidates", "goal", "measurements", "track", "tool", "target")
"""What is drawn beside a world; tests hold them against `torchdyn_plan.view.marks`, which takes long to import."""
SHOWN = "Planners that are shown side by side."
TRACK_TEXT = "Filter between sensor and planner; with none planners see the newest measurement, held."
RECORDED = (
    "File of recorded tracks to take for paths, .csv, .parquet, .npy or .npz: time [s], x, y and z [m], track. "
    "Nothing is simulated then."
)


def check_words(words: Sequence[str]) -> None:
    """Raise `InputError` for an option that is given nothing: an empty folder would be the one that one is in."""
    for before, word in zip(("", *words), words, strict=False):
        if not word.strip() or (word.startswith("--") and word.endswith("=")):
            option = word.rstrip("=") if word.strip() else before
            raise InputError(f"{option or 'a word'} is given nothing")


def task_of(words: Sequence[str]) -> tuple[str, str | None, list[str]]:
    """The task and the scene that ``--task NAME`` and ``--scene NAME`` name, and the other words.

    The last of several counts. The scene is None if none is named.
    """
    named: dict[str, str | None] = {"--task": DEFAULT, "--scene": None}
    others, rest = [], iter(words)
    for word in rest:
        option, equals, value = word.partition("=")
        if option not in named:
            others.append(word)
            continue
        value = value if equals else next(rest, "")
        if not value or value.startswith("-"):
            known = f"choose from {', '.join(task_names())}, or give package.module:NAME"
            raise InputError(f"{option} names none" + (f"; {known}" if option == "--task" else ""))
        named[option] = value
    task = named["--task"]
    assert task is not None
    return task, named["--scene"], others


def command_forms(task: Task, named: str) -> dict[str, type[Any]]:
    """The arguments of each command but ``train`` and ``bench`` for ``task``, which the words call ``named``."""
    return {
        "evaluate": _episode_form(EvaluateArguments, task, named),
        "sweep": _episode_form(SweepArguments, task, named, over=_over(task), engine=_engine()),
        "report": ReportArguments,
        "collect": _form(
            CollectArguments,
            **_task_options(task, named),
            what=_option(str, "Which data.", choices=("paths", "arrivals", "captures"), positional=True),
            static=_static_option(task, "Static planner whose arrivals or captures are recorded."),
            tracks=_option(Path | None, RECORDED, default=None, name="from"),
        ),
        "view": _planner_form(ViewArguments, task, named, SHOWN),
        "record": _planner_form(RecordArguments, task, named, SHOWN, layers=_layers(), film=_prefixed(FilmArguments)),
    }


def bench_forms(task: Task, named: str) -> dict[str, type[Arguments]]:
    """The arguments of each benchmark on ``task``, which the words call ``named``."""
    choices = "|".join([*task.planners, *task.static_planners, "TASK-STATIC", "FOLDER", "package.module:NAME"])
    planner = "A planner that is timed, once for each: by name, of those that ship or in a folder too, or at a place."
    default = "Those of the task that plan on what is seen when none is given."
    return {
        "replan": _form(
            ReplanArguments,
            **_task_options(task, named),
            planner=_repeated_option(f"{planner} {default}", choices),
            static=_static_option(task, "Static planner on which the task's own planners are built."),
        ),
        "env": _form(EnvArguments, **_task_options(task, named)),
        "kinematics": _form(KinematicsArguments, **_task_options(task, named)),
        "all": _form(SeriesArguments, **_task_options(task, named)),
    }


def train_forms(task: Task, named: str) -> dict[str, type[Arguments]]:
    """The arguments of training each network of ``task``, which the words call ``named``."""
    from torchdyn_plan.training.algorithms import ALGORITHMS
    from torchdyn_plan.training.train import networks

    fitted = [network for network in networks(task) if network not in task.policies]
    static = _option(
        str | None,
        f"Static planner whose data is learned, {task.default_static} when not given; folders carry its name.",
        choices=task.static_planners,
        default=None,
    )
    shared = {**_task_options(task, named), "static": static}
    forms = {network: _form(FitArguments, FITTED[network], **shared) for network in fitted}
    for name, training in task.policies.items():
        options = _group(_plain(training.options))
        text = "How it learns: averaged takes the least time; the recipe's own way when not given, which is ddpg."
        algorithm = _option(str | None, text, choices=ALGORITHMS, default=None)
        forms[name] = _form(
            PolicyArguments, training.summary, **_task_options(task, named), training=options, algorithm=algorithm
        )
    return forms


def _episode_form(base: type[EpisodeArguments], task: Task, named: str, **own: Any) -> type[PlannerArguments]:
    return _planner_form(base, task, named, "Planners for the moving target.", planners=task.default_planners, **own)


def _planner_form(
    base: type[PlannerArguments], task: Task, named: str, text: str, *, planners: tuple[str, ...] = (), **own: Any
) -> type[PlannerArguments]:
    return _form(
        base,
        **_task_options(task, named),
        planners=_option(tuple[str, ...], text, choices=task.planners, default=planners or task.default_planners[-1:]),
        static=_static_option(task, "Static planner that drives the robot."),
        settings=_group(_settings_form(task)),
        sensor=_prefixed(_plain(Sensor)),
        track=_option(str, TRACK_TEXT, choices=TRACKS, default=TRACKS[0]),
        track_settings=_prefixed(TrackArguments, "track"),
        **own,
    )


def _settings_form(task: Task) -> type[Any]:
    """The task's settings as bare values, without their checks."""
    kinds = typing.get_type_hints(task.settings)
    fields = {}
    for one in dataclasses.fields(task.settings):
        about = one.metadata
        unit = f" [{about['unit']}]" if about.get("unit") else ""
        text = f"{about.get('text', one.name)}{unit}."
        fields[one.name] = _option(kinds[one.name], text, choices=about.get("choices", ()), default=one.default)
    return _form(None, f"Settings of {task.name}.", **fields)


def _layers() -> tuple[Any, Any]:
    return _option(tuple[str, ...], "What is drawn beside the world.", choices=LAYERS, default=LAYERS)


def _over(task: Task) -> Any:
    names = [one.name for one in dataclasses.fields(task.settings) if one.metadata.get("sweep")]
    return _option(str, "What varies.", choices=names)


def _engine() -> Any:
    text = "Where points are run: here, or by the workers of a Ray cluster, with the same results."
    return _option(str, text, choices=ENGINES, default=ENGINES[0])


def _static_option(task: Task, text: str) -> Any:
    return _option(str, text, choices=task.static_planners, default=task.default_static)


def _task_options(task: Task, named: str) -> dict[str, Any]:
    """Options of the task, and of its scene if it has several."""
    text = f"Task: {', '.join(task_names())}, or package.module:NAME. It decides what there is to choose from."
    found = {"task": _option(str, text, default=named)}
    if task.scenes:
        found["scene"] = _option(str, "Scene of the task.", choices=task.scenes, default=task.scene)
    return found


def _option(
    kind: Any,
    text: str,
    *,
    choices: Iterable[Any] = (),
    default: Any = dataclasses.MISSING,
    positional: bool = False,
    name: str | None = None,
) -> tuple[Any, Any]:
    """Type and field of an option, with what ``--help`` says of it; ``name`` is its own, if not the field's."""
    import tyro

    shown = "{" + ",".join(map(str, choices)) + "}" if choices else None
    if shown and kind == tuple[str, ...]:
        shown = f"[{shown} ...]"
    marks: list[Any] = [tyro.conf.arg(name=name, help=text, metavar=shown)]
    if positional:
        marks.append(tyro.conf.Positional)
    return typing.Annotated[(kind, *marks)], dataclasses.field(default=default)


def _repeated_option(text: str, shown: str) -> tuple[Any, Any]:
    """Type and field of an option that may be given several times, a word each."""
    import tyro

    marks = tyro.conf.UseAppendAction, tyro.conf.arg(help=text, metavar=shown)
    return typing.Annotated[(tuple[str, ...], *marks)], dataclasses.field(default=())


def _group(kind: type[Any]) -> tuple[Any, Any]:
    """Type and field of the options that the dataclass ``kind`` has, without a prefix."""
    import tyro

    return typing.Annotated[kind, tyro.conf.OmitArgPrefixes], dataclasses.field(default_factory=kind)


def _prefixed(kind: type[Any], prefix: str | None = None) -> tuple[Any, Any]:
    """Type and field of the options that the dataclass ``kind`` has, behind a ``prefix`` and a point.

    The prefix is the field's name for None.
    """
    import tyro

    return typing.Annotated[kind, tyro.conf.arg(name=prefix)], dataclasses.field(default_factory=kind)


def _form(base: type[Any] | None, summary: str = "", **options: tuple[Any, Any]) -> type[Any]:
    """A dataclass like ``base`` with some fields replaced by ``options``, or added."""
    fields = [(name, kind, own) for name, (kind, own) in options.items()]
    bases = () if base is None else (base,)
    made = dataclasses.make_dataclass("Form", fields, bases=bases, frozen=True, kw_only=True)
    made.__doc__ = summary or (base.__doc__ if base else "")
    return made


def _plain(options: type[Any]) -> type[Any]:
    """The dataclass ``options`` without its checks: a parser would take their errors for its own."""
    return type(options.__name__, (options,), {"__post_init__": lambda self: None, "__doc__": options.__doc__})
