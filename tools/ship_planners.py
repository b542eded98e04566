"""Writes the planners that ship, `torchdyn_plan/weights/planner-NAME.json`, as their tasks make them.

python tools/ship_planners.py
"""

# ruff: noqa: T201
from pathlib import Path
from typing import Any

from torchdyn_plan.files import write_json
from torchdyn_plan.nets.pretrained import SHIPPED, Pretrained
from torchdyn_plan.planners.pretrained import describe_planner
from torchdyn_plan.tasks import load_task

NAMES = {"corner": "", "wait_and_drop": "-wait_and_drop"}
"""Planners that ship, and what follows task and static planner in their names."""


def shipped_planners() -> dict[str, dict[str, Any]]:
    """Name of each planner that ships, and its description."""
    found = {}
    for task in map(load_task, ("trapper", "fetch_reach")):
        for static in task.static_planners:
            # Weights are shared: a network's file is named after its task, and after the static planner if it is the
            # static planner's.
            files = {"eta": f"{task.name}-{static}", "forecaster": task.name, "spread": task.name, "policy": task.name}

            def file_of(network: Pretrained, files: dict[str, str] = files) -> str:
                return f"{network.kind}-{files[network.kind]}.safetensors"

            for planner, ending in NAMES.items():
                if planner in task.planners:
                    found[f"{task.name}-{static}{ending}"] = describe_planner(task.planner(planner, static), file_of)
    return found


def main(folder: Path = SHIPPED) -> None:
    """Write them."""
    for name, content in shipped_planners().items():
        write_json(folder / f"planner-{name}.json", content)
        print(folder / f"planner-{name}.json")


if __name__ == "__main__":
    main()
