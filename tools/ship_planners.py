"""Writes the planners that ship, `torchdyn_plan/weights/planner-NAME.json`, as their tasks make them.

python tools/ship_planners.py
"""

# ruff: noqa: T201
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from torchdyn_plan.files import write_json
from torchdyn_plan.nets import CaptureNetwork, ETANetwork, Forecaster, SpreadNetwork
from torchdyn_plan.nets.policy import Actor
from torchdyn_plan.nets.pretrained import SHIPPED, Pretrained
from torchdyn_plan.planners.pretrained import describe_planner
from torchdyn_plan.tasks import Task, load_task

NAMES = {"corner": "", "wait_and_drop": "-wait_and_drop"}
"""Planners that ship, and what follows task and static planner in their names."""


def shipped_planners() -> dict[str, dict[str, Any]]:
    """Name of each planner that ships, and its description."""
    found = {}
    for task in tasks():
        for static in task.static_planners:
            for planner, ending in NAMES.items():
                if planner in task.planners:
                    name = f"{task.weights_name}-{static}"
                    file_of = partial(weights_file, task, name)
                    found[f"{name}{ending}"] = describe_planner(task.planner(planner, static), file_of)
    return found


def tasks() -> Iterator[Task]:
    """Those whose planners ship, in each of their scenes."""
    for task in map(load_task, ("trapper", "fetch_reach")):
        yield from [task.in_scene(scene) for scene in task.scenes] or [task]


def weights_file(task: Task, own: str, network: Pretrained) -> str:
    """File of ``network`` of a planner of ``task``; arrivals and captures are those of the static planner, ``own``."""
    if isinstance(network, CaptureNetwork):
        return f"{network.kind}-{own}.safetensors"
    if isinstance(network, ETANetwork):
        return f"{network.kind}-{own}{'' if network.config.never else '-nearest'}.safetensors"
    shared = task.weights_name if isinstance(network, Actor) else task.path_weights or task.weights_name
    noisy = isinstance(network, (Forecaster, SpreadNetwork)) and network.config.tracked
    return f"{network.kind}-{shared}{'-noisy' if noisy else ''}.safetensors"


def main(folder: Path = SHIPPED) -> None:
    """Write them."""
    for name, content in shipped_planners().items():
        write_json(folder / f"planner-{name}.json", content)
        print(folder / f"planner-{name}.json")


if __name__ == "__main__":
    main()
