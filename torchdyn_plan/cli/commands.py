"""What each command does; what it works with is imported when it runs."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, fields, replace
from typing import TYPE_CHECKING, Any

from torchdyn_plan.cli.arguments import (
    BENCHMARKS,
    DATA,
    TRAINING,
    BenchArguments,
    CollectArguments,
    EpisodeArguments,
    EvaluateArguments,
    FitArguments,
    PlannerArguments,
    PolicyArguments,
    RecordArguments,
    ReplanArguments,
    ReportArguments,
    SweepArguments,
    TrainArguments,
    ViewArguments,
    default_folder,
)
from torchdyn_plan.cli.output import say
from torchdyn_plan.errors import InputError, OutputError
from torchdyn_plan.tasks import Task, import_planner

if TYPE_CHECKING:
    from torchdyn_plan.envs.sensor import Sensor
    from torchdyn_plan.planners import Delivery, Track
    from torchdyn_plan.view import Scenario


def run(task: Task | None, arguments: Any) -> None:
    """Run the command that takes these arguments; benchmarks and reports may be given no task."""
    command = next(function for form, function in COMMANDS.items() if isinstance(arguments, form))
    command(task, arguments)


def with_folders(task: Task, arguments: Any) -> Any:
    """``arguments`` with the folders that they leave open."""
    from torchdyn_plan.checks import check_choice

    if isinstance(arguments, (CollectArguments, FitArguments)) and arguments.static:
        check_choice(f"static planner of {task.name}", arguments.static, task.static_planners)
    if isinstance(arguments, CollectArguments):
        static = arguments.planner or arguments.static or task.default_static
        return replace(arguments, out=arguments.out or default_folder(DATA, task.weights_name, static))
    if isinstance(arguments, FitArguments):
        static = arguments.static or task.default_static
        data = arguments.data or default_folder(DATA, task.weights_name, static)
        return replace(arguments, data=data, out=arguments.out or default_folder(TRAINING, task.weights_name, static))
    if isinstance(arguments, TrainArguments):
        return replace(arguments, out=arguments.out or default_folder(TRAINING, task.weights_name))
    return arguments


def evaluate(task: Task, arguments: EvaluateArguments) -> None:
    """Run the episodes, write the results and print the table."""
    from torchdyn_plan.evaluation import evaluate

    task.default_settings(**asdict(arguments.settings))
    try:
        found = evaluate(task, arguments.planners, out=arguments.out, **_shared(task, arguments))
    except OutputError as error:
        for note in getattr(error, "__notes__", ()):
            say(note)
        raise
    say(found.table())
    if arguments.out is not None:
        say(f"\nwritten: {', '.join(str(path) for path in sorted(arguments.out.iterdir()))}")


def sweep(task: Task, arguments: SweepArguments) -> None:
    """Run or continue the sweep and print its table."""
    from torchdyn_plan.evaluation.report import format_table
    from torchdyn_plan.evaluation.sweep import sweep

    rows = sweep(
        task,
        arguments.planners,
        over=arguments.over,
        out=arguments.out,
        values=arguments.values,
        repeats=arguments.repeats,
        engine=arguments.engine,
        workers=arguments.workers,
        **_shared(task, arguments),
    )
    say(format_table(task, rows))


def report(task: Task | None, arguments: ReportArguments) -> None:
    """Draw the figures of the task's paper, or of all tasks' papers, and say what there are no results of."""
    from torchdyn_plan.evaluation.paper_figures import draw_report

    found = draw_report(arguments.out, results=arguments.results, tasks=None if task is None else [task])
    say(f"written: {', '.join(map(str, found.files))}")
    if found.missing:
        say("\n".join(["no results of ours, the paper's curve alone:", *found.missing]))


def collect(task: Task, arguments: CollectArguments) -> None:
    """Gather the data."""
    from torchdyn_plan.files import check_writable_folder
    from torchdyn_plan.training.collect import collect, collect_tracks

    assert arguments.out is not None
    if arguments.tracks is not None and arguments.what != "paths":
        raise InputError(f"--from is of paths, not of {arguments.what}")
    if arguments.planner and arguments.what != "arrivals":
        raise InputError(f"--planner is of arrivals, not of {arguments.what}")
    own = {"planner": import_planner(arguments.planner), "name": arguments.planner} if arguments.planner else {}
    check_writable_folder(arguments.out)
    if arguments.tracks is not None:
        count = collect_tracks(task, arguments.tracks, arguments.out, seed=arguments.seed)
        say(f"{count} tracks in control steps of {task.control_step:g} s, written to {arguments.out}")
        return

    collect(
        task,
        arguments.what,
        arguments.out,
        episodes=arguments.episodes,
        seed=arguments.seed,
        num_envs=arguments.num_envs,
        num_threads=arguments.threads,
        static=arguments.static,
        weights=arguments.weights,
        **own,
    )


def train(task: Task, network: str, arguments: TrainArguments) -> None:
    """Train the network, or go on where its folder stands."""
    from torchdyn_plan.files import check_writable_folder
    from torchdyn_plan.training.train import train

    assert arguments.out is not None
    check_writable_folder(arguments.out)
    data = arguments.out

    own: dict[str, Any] = {}
    if isinstance(arguments, PolicyArguments):
        own["options"] = task.policies[network].options(**asdict(arguments.training))
        own |= {"num_envs": arguments.num_envs, "num_threads": arguments.threads, "workers": arguments.workers}
        own["algorithm"] = arguments.algorithm
    elif isinstance(arguments, FitArguments):
        assert arguments.data is not None
        data = arguments.data
        own["static"] = arguments.static
    train(
        task,
        network,
        data,
        arguments.out,
        steps=arguments.steps,
        batch=arguments.batch,
        lr=arguments.lr,
        seed=arguments.seed,
        device=arguments.device,
        resume=arguments.resume,
        **own,
    )


def bench(task: Task | None, arguments: BenchArguments) -> None:
    """Measure; write and print each figure once it is there."""
    benchmark = importlib.import_module(BENCHMARKS[arguments.benchmark])
    own = {one.name: getattr(arguments, one.name) for one in fields(arguments) if one.name != "scene"}
    if task is not None or isinstance(arguments, ReplanArguments):
        own["task"] = task
    if isinstance(arguments, ReplanArguments):
        own["planner"] = arguments.planner or None
    rows = benchmark.bench(**own, show=_print_row)
    if arguments.out is not None and hasattr(benchmark, "plot"):
        benchmark.plot(rows, arguments.out.with_suffix(".png"))


def _print_row(row: Mapping[str, Any]) -> None:
    """A line for a row, above the bar of progress."""
    from tqdm import tqdm

    with tqdm.external_write_mode(file=sys.stdout):
        say("  ".join(f"{name} {_short(value)}" for name, value in row.items()))


def _short(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def view(task: Task, arguments: ViewArguments) -> None:
    """Serve the page until it is interrupted."""
    from torchdyn_plan.view import serve

    serve(_scenarios(task, arguments), port=arguments.port, show=say)


def record(task: Task, arguments: RecordArguments) -> None:
    """Play the episode with each planner, draw it and write the file."""
    from torchdyn_plan.view import draw_without_screen

    draw_without_screen()
    from torchdyn_plan.view import Film, check_film, record_episode, write_film
    from torchdyn_plan.view.words import outcome

    how = asdict(arguments.film)
    size = {name: how.pop(name) for name in ("width", "height")}
    check_film(arguments.out, strip=how["strip"], quality=how["quality"])
    recordings = [record_episode(scenario) for scenario in _scenarios(task, arguments)]
    for recording in recordings:
        say(f"{recording.scenario.planner}: {outcome(recording)}")
    film = Film(recordings, layers=arguments.layers, **size)
    write_film(film, arguments.out, progress=_drawing, **how)
    say(f"written: {arguments.out}, {arguments.out.stat().st_size / 1024:.0f} kB")


def _drawing(steps: Iterable[int]) -> Iterable[int]:
    """``steps``, and how far they are drawn."""
    from torchdyn_plan.progress import progress_bar

    return progress_bar(steps, desc="drawing", unit="picture", leave=False)


def _scenarios(task: Task, arguments: ViewArguments | RecordArguments) -> list[Scenario]:
    """The episode as each of the planners plays it."""
    from torchdyn_plan.view import Scenario

    if not arguments.planners:
        raise InputError(f"planners must name at least one of {', '.join(task.planners)}")
    sensor = _sensor(arguments)
    shared: dict[str, Any] = {
        "task": task,
        "static": arguments.static,
        "settings": task.default_settings(**asdict(arguments.settings)),
        "weights": arguments.weights,
        "delivery": _delivery(task, arguments),
        "sensor": sensor,
        "track": _track(arguments, sensor),
    }
    names = ("episode", "seed", "split")
    shared |= {name: getattr(arguments, name) for name in names}
    return [Scenario(planner=name, **shared) for name in arguments.planners]


COMMANDS: dict[type[Any], Callable[[Any, Any], None]] = {
    EvaluateArguments: evaluate,
    SweepArguments: sweep,
    ReportArguments: report,
    CollectArguments: collect,
    BenchArguments: bench,
    ViewArguments: view,
    RecordArguments: record,
}
"""The arguments of each command but ``train``, and the function that serves it."""


def _shared(task: Task, arguments: EpisodeArguments) -> dict[str, Any]:
    """What evaluations and sweeps are given alike."""
    sensor = _sensor(arguments)
    return {
        "static": arguments.static,
        "episodes": arguments.episodes,
        "seed": arguments.seed,
        "split": arguments.split,
        "num_envs": arguments.num_envs,
        "num_threads": arguments.threads,
        "delivery": _delivery(task, arguments),
        "sensor": sensor,
        "track": _track(arguments, sensor),
        "weights": arguments.weights,
        "overwrite": arguments.overwrite,
        **asdict(arguments.settings),
    }


def _sensor(arguments: PlannerArguments) -> Sensor | None:
    """How targets are measured; None if exactly."""
    from torchdyn_plan.envs.sensor import Sensor

    sensor = Sensor(**asdict(arguments.sensor))
    return None if sensor.is_exact else sensor


def _track(arguments: PlannerArguments, sensor: Sensor | None) -> Track | None:
    """What becomes of the measurements before planners see them; None if nothing does."""
    from torchdyn_plan.evaluation.tracks import track_named

    settings = {name: value for name, value in asdict(arguments.track_settings).items() if value is not None}
    return track_named(arguments.track, sensor, **settings)


def _delivery(task: Task, arguments: PlannerArguments) -> Delivery | None:
    """How plans come late; None if they do not."""
    from torchdyn_plan.checks import check_number
    from torchdyn_plan.planners import Delayed

    step_ms = 1000 * task.control_step
    check_number("latency_ms", arguments.latency_ms, minimum=0.0)
    if arguments.latency_ms > step_ms * task.max_steps:
        longest = f"an episode of {task.name}, {step_ms * task.max_steps:g} ms"
        raise InputError(f"latency_ms must be no longer than {longest}, got {arguments.latency_ms:g}")
    steps = round(arguments.latency_ms / step_ms)
    # A millionth of a step is rounding.
    if abs(arguments.latency_ms / step_ms - steps) > 1e-6:
        raise InputError(f"latency_ms must be whole control steps of {step_ms:g} ms, got {arguments.latency_ms:g}")
    return Delayed(steps, compensate=arguments.compensate) if steps else None
