"""Every command in small, each a few seconds long: to be killed, to be run on a full disk."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.torture import forked

SHARDS = {"paths": 8, "arrivals": 1}
"""Episodes in a shard, so that a collection of seconds has several."""
SCORED = 8
"""Episodes that networks are scored on."""
TIMES = ("seconds", "episodes_per_second", "machine", "versions", "hours")
"""Entries of JSON that say how long something took, or where."""
TRAINED = ("forecaster", "eta", "spread", "policy", "reach forecaster", "reach policy", "dher")
"""Names of those of `COMMANDS` that train a network."""
FIT = "--steps 40 --batch 32 --data {data}"
ROUNDS = "--steps 4 --num-envs 4 --batch 64 --threads 1"
COMMANDS = {
    "evaluate": "evaluate --planners corner pursuit --episodes 2 --num-envs 2 --threads 1",
    "sweep": "sweep --over velocity --values 1 3 --planners pursuit --episodes 1 --repeats 3 --threads 1",
    "collect paths": "collect paths --episodes 40 --num-envs 8 --threads 1",
    "collect arrivals": "collect arrivals --episodes 4 --num-envs 16 --threads 1",
    "forecaster": f"train forecaster {FIT}",
    "eta": f"train eta {FIT}",
    "spread": f"train spread {FIT}",
    "policy": f"train policy {ROUNDS}",
    "reach forecaster": f"train forecaster --task fetch_reach {FIT}",
    "reach policy": f"train policy --task fetch_reach {ROUNDS}",
    "dher": f"train dher --task fetch_reach {ROUNDS}",
}


def prepare(folder: Path) -> None:
    """Collect, into ``folder``, the data that the trainings in small read."""
    for task in ("trapper", "fetch_reach"):
        for what, episodes in (("paths", 24), ("arrivals", 2)):
            words = f"collect {what} --task {task} --episodes {episodes} --num-envs 16 --threads 1 --out".split()
            ended = forked.run(lambda words=words, task=task: start([*words, str(folder / task)]), at_most=300.0)
            if ended.code:
                raise SystemExit(f"could not collect data for the trainings: {ended.told}")


def words_of(name: str, out: Path, data: Path) -> list[str]:
    """The words of the command ``name`` that writes into ``out``."""
    task = "fetch_reach" if "fetch_reach" in COMMANDS[name] else "trapper"
    return [*COMMANDS[name].format(data=data / task).split(), "--out", str(out)]


def start(words: Sequence[str], before: Callable[[], object] = lambda: None) -> None:
    """The command of ``words`` with small shards and scores and a checkpoint at each step; for a process of its own."""
    from torchdyn_plan.cli import main
    from torchdyn_plan.tasks.fetch_reach.policy import FetchGoalTask
    from torchdyn_plan.tasks.trapper import data
    from torchdyn_plan.tasks.trapper.policy import TrapperGoalTask
    from torchdyn_plan.training import optimise, policy, shards

    shards.SHARD.update(SHARDS)
    data.ROLLED = SCORED
    for scored in (TrapperGoalTask, FetchGoalTask):
        _default(scored.__init__, "episodes", SCORED)
    _default(optimise.Recipe.__init__, "checkpoint_seconds", 0.0)
    _default(policy.fit_policy, "checkpoint_seconds", 0.0)
    before()
    main(words)


def _default(function: Any, name: str, value: Any) -> None:
    assert name in function.__kwdefaults__, f"{function} has no {name} any more"
    function.__kwdefaults__[name] = value


def ends(out: Path) -> dict[str, Any]:
    """What is in ``out`` but for times: of each file its tensors, its JSON, or nothing but that it is there."""
    found: dict[str, Any] = {}
    for file in sorted(out.rglob("*")):
        name = str(file.relative_to(out))
        if file.is_file() and not name.startswith("events.") and "/events." not in name:
            found[name] = _content(file)
    return found


def _content(file: Path) -> Any:
    if file.suffix == ".json":
        return untimed(json.loads(file.read_text()), file.parent.parent)
    if file.suffix == ".safetensors":
        from torchdyn_plan.errors import InputError
        from torchdyn_plan.files import read_tensors

        return {name: (value.dtype, value.tolist()) for name, value in read_tensors(file, InputError)[1].items()}
    return None


def untimed(content: Any, place: Path) -> Any:
    """``content`` without times, and without the names of folders."""
    if isinstance(content, Mapping):
        kept = {name: value for name, value in content.items() if name not in TIMES and name not in ("out", "content")}
        return {name: untimed(value, place) for name, value in kept.items()}
    if isinstance(content, list):
        return [untimed(value, place) for value in content]
    return content


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Names of files that are in but one of two results, or differ."""
    return sorted(
        name
        for name in one.keys() | other.keys()
        if name not in one or name not in other or _differ(one[name], other[name])
    )


def _differ(one: Any, other: Any) -> bool:
    """Whether two contents differ; NaN is itself."""
    return repr(one) != repr(other)


def whole(out: Path) -> str | None:
    """What is broken in ``out``: a half-written file under its own name."""
    for file in out.rglob("*"):
        hidden = any(part.startswith(".torchdyn_plan-") for part in file.parts)
        if file.is_file() and not hidden and not file.name.startswith("events."):
            try:
                _content(file)
            except Exception as error:
                return f"{file.relative_to(out)} is broken: {error}"
    return None
