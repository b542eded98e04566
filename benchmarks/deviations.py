"""Effect of each of our deviations from the paper on the paper's own planner: each is undone alone.

python benchmarks/deviations.py --out benchmarks/results/deviations.json

The forecaster is given the cushions and the symmetry of the table, the policy learns on goals that change during an
episode, and the IK planner hovers, drops and lifts by construction. For each of these, our version and the paper's are
trained here with the same data, steps and seed, and the same planners play the same episodes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from study import Episodes, Row, Setting, Study, change_entries, each, measuring, success_of

from torchdyn_plan.nets import ETANetwork, Forecaster
from torchdyn_plan.planners import IKPlanner, TargetPursuit
from torchdyn_plan.tasks import Task, load_task
from torchdyn_plan.tasks.trapper.policy import TrapperGoalTask
from torchdyn_plan.tasks.trapper.task import policy_planner
from torchdyn_plan.training.algorithms import recipe_for
from torchdyn_plan.training.collect import collect
from torchdyn_plan.training.fit import fit_eta, fit_forecaster, task_fitting
from torchdyn_plan.training.goal_task import DDPGRecipe
from torchdyn_plan.training.policy import fit_policy

Parts = dict[str, Any]
"""Parts of a planner, by name."""
DIRECT = 10.0
"""A box that drops within this distance of its goal neither hovers nor lifts [m]."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Episodes):
    """Take each deviation back, and play the same episodes."""

    scene: str = "paper"
    """Scene of the task."""
    velocities: tuple[float, ...] = (1.0, 3.0, 5.0)
    """Of the ball [m/s]."""
    planners: tuple[str, ...] = ("pursuit", "corner")
    """Planners for the moving target."""
    data: Path = Path("runs/deviations")
    """Folder for data and networks, in which a killed run continues."""
    paths: int = 8192
    """Paths of balls from which forecasters learn."""
    sequences: int = 8192
    """Sequences of runs from which arrival times are learned."""
    steps: int = 8000
    """Steps in which each network is fitted."""
    rounds: int = 100
    """Rounds of training of each policy."""


@dataclass(frozen=True)
class Deviation:
    """What we do otherwise than the paper."""

    what: str
    static: str
    """Static planner with which it is tried."""
    ours: Parts
    paper: Parts


def main(arguments: Arguments) -> None:
    """Run, save and print."""
    task = load_task("trapper", arguments.scene)
    study = Study(arguments, scene=task.digest())
    for deviation in deviations(task, arguments):
        for velocity in each(arguments.velocities, deviation.what):
            setting = Setting(task, arguments, static=deviation.static, velocity=velocity)
            for name in arguments.planners:
                compare(study, setting, deviation, name)


def deviations(task: Task, arguments: Arguments) -> Iterator[Deviation]:
    """Each of them, trained one after the other."""
    told, untold = (forecaster(task, arguments, told=told) for told in (True, False))
    yield Deviation("forecaster is told cushions and symmetry", "ik", {"forecaster": told}, {"forecaster": untold})
    hovering: Any = task.static_planner("ik")
    settings = hovering.part_settings()
    straight = IKPlanner(**settings | {"approach": replace(settings["approach"], drop_distance=DIRECT)})
    ours, theirs = (
        driven(task, arguments, static, name) for static, name in ((hovering, "hover"), (straight, "straight"))
    )
    yield Deviation("IK hovers and lifts", "ik", ours, theirs)
    ours, theirs = (policy(task, arguments, redirected=redirected) for redirected in (True, False))
    yield Deviation("policy learns on goals that change", "rl", ours, theirs)


def forecaster(task: Task, arguments: Arguments, *, told: bool) -> Forecaster:
    """A forecaster that is ``told`` of cushions and symmetry, or learns them."""
    fitting, data = task_fitting(task), arguments.data / "paths"
    collect(task, "paths", data, episodes=arguments.paths, num_threads=arguments.threads)
    config, recipe = fitting.forecaster, replace(fitting.recipe("forecaster"), steps=arguments.steps)
    if not told:
        config = replace(config, half_extent=None, square_symmetry=False)
    folder = arguments.data / ("told" if told else "untold")
    return Forecaster.from_pretrained(fit_forecaster(task, data, folder, recipe, config=config))


def driven(task: Task, arguments: Arguments, static: Any, name: str) -> Parts:
    """``static``, and its arrival times as the paper has them, collected and learned in a folder of that ``name``."""
    fitting, folder = task_fitting(task), arguments.data / name
    about: Any = {"episodes": arguments.sequences, "num_envs": 512, "num_threads": arguments.threads}
    collect(task, "arrivals", folder / "arrivals", planner=static, name=name, **about)
    config, recipe = replace(fitting.eta, never=False), replace(fitting.recipe("eta"), steps=arguments.steps)
    weights = fit_eta(task, folder / "arrivals", folder, recipe, config=config, static=name)
    return {"static": static, "eta": ETANetwork.from_pretrained(weights)}


def policy(task: Task, arguments: Arguments, *, redirected: bool) -> Parts:
    """A policy whose goals in training change in mid-episode, or do not, and its arrival times."""
    name = "changing" if redirected else "fixed"
    goals = TrapperGoalTask(scene=arguments.scene, redirected=redirected, num_threads=arguments.threads)
    recipe = replace(recipe_for("averaged", DDPGRecipe()), iterations=arguments.rounds)
    file = fit_policy(goals, arguments.data / name, recipe=recipe)
    return driven(task, arguments, policy_planner(arguments.scene, weights=file), name)


def compare(study: Study, setting: Setting, deviation: Deviation, name: str) -> None:
    """A row for the planner of that name in our way, and one in the paper's."""
    ours: Row | None = None
    for way in ("ours", "paper"):
        parts = getattr(deviation, way)

        def measure(parts: Parts = parts, ours: Row | None = ours) -> Row:
            with measuring():
                found = success_of(setting.play(planner(setting, name, parts), name))
            return found | change_entries(ours or found, found)

        row = study.row({"deviation": deviation.what, "way": way, "planner": name, **setting.about}, measure)
        ours = ours or row


def planner(setting: Setting, name: str, parts: Parts) -> Any:
    """The planner of that name, made of these parts."""
    if name != "pursuit":
        return setting.planner(name, **parts)
    return TargetPursuit(parts.get("static") or setting.task.static_planner(setting.static)).eval()


if __name__ == "__main__":
    main(tyro.cli(Arguments))
