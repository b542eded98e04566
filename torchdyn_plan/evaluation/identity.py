"""Identity of a result, and the check that a folder never mixes results."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

from torchdyn_plan.errors import InputError
from torchdyn_plan.files import exists, read_json, short_path
from torchdyn_plan.schemas import check_content
from torchdyn_plan.versions import library_versions

FREE = ("num_envs", "num_threads", "values", "repeats")
"""Settings that do not change results, or only add points to a sweep."""
SWEEP, POINTS = "sweep.json", "points"
"""Contents of a sweep's folder: its identity, and the folder of its points."""
RESULTS, EPISODES = "results.json", "episodes.json"
"""Files of an evaluation; a sweep also has the first of them."""


class Results(TypedDict):
    """Content of ``results.json`` that is read back."""

    config: dict[str, Any]
    versions: dict[str, str | None]


def identity_of(config: Mapping[str, Any], version: str | None = None) -> dict[str, Any]:
    """Everything that determines a result: task, planners, weights, scene, episodes, settings and package version.

    ``config`` is the configuration from `torchdyn_plan.evaluation.study.Study`; ``version`` is the package's, the
    installed one for None.
    """
    decides = {name: value for name, value in config.items() if name not in FREE}
    # One line for each setting and for each planner's weights, so that an error can name the one that differs.
    for name in ("settings", "weights"):
        parts = decides.pop(name, {})
        prefix = "weights of " if name == "weights" else ""
        decides |= {f"{prefix}{part}": value for part, value in parts.items()} if isinstance(parts, Mapping) else {}
    decides["version"] = version or library_versions()["torchdyn-plan"]
    return json.loads(json.dumps(decides))


def digest_of(identity: Mapping[str, Any]) -> str:
    """A short digest of an identity."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]


def check_evaluation_folder(folder: Path, config: Mapping[str, Any]) -> None:
    """Raise `InputError` if ``folder`` holds a sweep, or an evaluation that is not of ``config``."""
    if exists(folder / SWEEP) or exists(folder / POINTS):
        raise InputError(f"folder {short_path(folder)} holds a sweep: give another folder, or overwrite it")
    file = folder / RESULTS
    if exists(file):
        there: Results = check_content(read_json(file), Results, short_path(file))
        version = there["versions"].get("torchdyn-plan") or "unknown"
        check_same(folder, "an evaluation", identity_of(there["config"], version), identity_of(config))


def check_sweep_folder(folder: Path, identity: Mapping[str, Any]) -> bool:
    """Whether ``folder`` holds a sweep of this identity; raises `InputError` if it holds any other results."""
    file = folder / SWEEP
    if exists(file):
        check_same(folder, "a sweep", check_content(read_json(file), dict[str, Any], short_path(file)), identity)
        return True
    for name in (RESULTS, EPISODES, POINTS):
        if exists(folder / name):
            what = "points without a word of what they are of" if name == POINTS else "an evaluation"
            raise InputError(f"folder {short_path(folder)} holds {what} ({name}): give another folder, or overwrite it")
    return False


def check_same(folder: Path, what: str, there: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    """Raise `InputError` naming the first entry in which the results ``there`` are of something else."""
    for name in (*here, *there):
        if there.get(name) != here.get(name):
            raise InputError(
                f"folder {short_path(folder)} holds {what} with another configuration: "
                f"{name} is {there.get(name)!r} there, {here.get(name)!r} here: give another folder, or overwrite it"
            )


def clear_results(folder: Path) -> None:
    """Remove every result of this package from ``folder``, and nothing else."""
    for name in (SWEEP, EPISODES, RESULTS, "results.png", "sweep.png"):
        (folder / name).unlink(missing_ok=True)
    if (folder / POINTS).is_dir():
        shutil.rmtree(folder / POINTS)
