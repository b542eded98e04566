"""The model card of a network: how it was made and how well it performs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchdyn_plan.files import write_json, write_whole
from torchdyn_plan.versions import library_versions, machine

if TYPE_CHECKING:
    from torchdyn_plan.nets.capture import CaptureNetwork
    from torchdyn_plan.nets.eta import ETANetwork
    from torchdyn_plan.nets.forecaster import Forecaster
    from torchdyn_plan.nets.spread import SpreadNetwork
    from torchdyn_plan.training.optimise import Recipe

Rows = list[dict[str, Any]]
Tables = dict[str, Rows]
"""Tables of figures by caption."""


def write_network(
    network: Forecaster | ETANetwork | CaptureNetwork | SpreadNetwork,
    folder: Path,
    score: Callable[[], Tables],
    *,
    task: str,
    recipe: Recipe,
    facts: Mapping[str, Any],
    network_name: str | None = None,
) -> Path:
    """Write a fitted network, its scores as ``scores.json`` and its card into ``folder``; returns the weights' file.

    ``network_name`` is the network's name on the command line; its kind for None.
    """
    network.eval()
    with torch.no_grad():
        tables = score()
    file = network.save_pretrained(folder)
    write_json(folder / "scores.json", tables)
    static = facts.get("static") or ""
    # Data of a planner of one's own, package.module:NAME, needs no such option.
    on = f" --static {static}" if static and ":" not in static else ""
    given = f"--steps {recipe.steps} --batch {recipe.batch} --lr {recipe.lr:g} --seed {recipe.seed}"
    facts = {
        "command": f"`torchdyn-plan train {network_name or network.kind} --task {task}{on} {given}`",
        "recipe": asdict(recipe),
        **facts,
        "network": asdict(network.config),
    }
    write_card(file.with_suffix(".md"), f"{type(network).__name__} of {task}", facts, tables)
    return file


def write_card(
    file: Path, title: str, facts: Mapping[str, Any], tables: Mapping[str, Sequence[Mapping[str, Any]]]
) -> None:
    """Write ``file`` as Markdown: a list of ``facts``, versions and machine, then a table for each of ``tables``."""
    facts = dict(facts) | {"versions": library_versions(), "machine": machine()}
    lines = [f"# {title}", ""]
    lines += [f"- {name}: {_plain(value)}" for name, value in facts.items()]
    for caption, rows in tables.items():
        lines += ["", f"## {caption}", "", *_table(rows)]
    write_whole(file, lambda temporary: temporary.write_text("\n".join(lines) + "\n"))


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_plain(entry)}" for name, entry in value.items())
    if isinstance(value, list):
        return "; ".join(_plain(entry) for entry in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    names = list(rows[0]) if rows else ["none"]
    lines = [names, ["---"] * len(names)]
    lines += [["–" if row[name] is None else _plain(row[name]) for name in names] for row in rows]
    return [f"| {' | '.join(line)} |" for line in lines]
