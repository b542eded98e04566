"""The fit of a spread to a frozen forecaster's errors, and how well it is calibrated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, softplus

from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.files import write_json
from torchdyn_plan.nets.forecaster import Forecaster
from torchdyn_plan.nets.spread import Spread, SpreadConfig, SpreadNetwork
from torchdyn_plan.training.arrivals import split_groups
from torchdyn_plan.training.card import read_description, write_card
from torchdyn_plan.training.collect import roll
from torchdyn_plan.training.fit import held_windows
from torchdyn_plan.training.metrics import coverage, swallowed_odds
from torchdyn_plan.training.optimise import Recipe, optimise
from torchdyn_plan.training.windows import (
    Paths,
    WindowConfig,
    Windows,
    cut_windows,
    draw_windows,
    last_useful_step,
    load_paths,
)

FRICTIONS = (0.0, 5.0, 9.5)
"""Friction losses at which coverage is reported [N]; only the first is in the data."""
ROLLED, ROLLED_VELOCITY = 512, 3.0
"""Balls rolled at each of them, and their velocity [m/s]."""
PRESENTS = (40, 100, 200)
"""Steps of each such ball at which it is forecast."""

Rows = list[dict[str, Any]]


def fit_spread(
    data: Path,
    out: Path,
    *,
    steps: int = 3_000,
    batch: int = 256,
    lr: float = 2e-3,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = True,
    config: SpreadConfig | None = None,
    forecaster: str | Path = "trapper",
    scene: TrapperScene | None = None,
) -> Path:
    """Fit a `SpreadNetwork` to the errors that ``forecaster`` makes on the ``paths`` in ``data``; it stays as it is.

    With the paths and the seed that the forecaster was fitted with, the same episodes are held out: coverage is
    measured on errors that neither network was fitted to.

    Args:
        data: folder of ``paths-*.safetensors`` and their descriptions.
        out: gets a folder ``spread`` with checkpoint, curve, weights, card and ``coverage.json``.
        steps: optimiser steps.
        batch: fresh random windows a step.
        lr: highest learning rate.
        seed: of initialisation, held-out episodes (one in ten) and draws.
        device: where to train.
        resume: whether to continue from the checkpoint in ``out``.
        config: of the network; by default with the forecaster's sizes.
        forecaster: name or file of the forecaster.
        scene: that the data must come from.

    Returns:
        The weights' file.

    Raises:
        InputError: data is missing, damaged or of another scene, or an argument is wrong.
        TrainingError: the loss is NaN, or the checkpoint is damaged or has other settings.
        WeightsError: the forecaster cannot be read.
    """
    recipe = Recipe(steps=steps, batch=batch, lr=lr, seed=seed, device=device, validations=8)
    scene = scene or TrapperScene()
    frozen = Forecaster.from_pretrained(forecaster, device=device).requires_grad_(False)
    sizes = frozen.config
    config = config or SpreadConfig(features=sizes.hidden, horizon=sizes.horizon)
    about = read_description(data, "paths", scene=scene.digest())
    folder = out / SpreadNetwork.kind
    drawing = WindowConfig(history=sizes.history, horizon=sizes.horizon)
    paths = load_paths(data)
    last = last_useful_step(paths, drawing)
    usable = (last >= drawing.first_step).nonzero().squeeze(-1)
    train, held = (usable[rows] for rows in split_groups(usable, seed))
    torch.manual_seed(seed)
    network = SpreadNetwork(config).to(device)

    def loss(generator: torch.Generator) -> Tensor:
        episodes = train[torch.randint(len(train), (batch,), generator=generator)]
        return spread_loss(frozen, network, draw_windows(paths, last, episodes, drawing, generator))

    windows = held_windows(paths, last, held, drawing, seed)
    settings = {"network": asdict(config), "scene": about["scene"], "episodes": len(paths.length)}
    settings["forecaster"] = str(forecaster)

    def validate() -> dict[str, float]:
        return {"loss_held": float(spread_loss(frozen, network, windows))}

    optimise(network, loss, validate, recipe, out=folder, settings=settings, resume=resume)
    file = network.eval().save_pretrained(folder)
    tables = _tables(frozen, network, windows, scene, drawing)
    write_json(folder / "coverage.json", tables)
    command = f"torchdyn-plan train spread --steps {steps} --batch {batch} --lr {lr:g} --seed {seed}"
    facts = {"command": f"`{command}`", "recipe": asdict(recipe), "data": about["arguments"], "scene": about["scene"]}
    facts |= {"episodes": len(paths.length), "held out": len(held), "forecaster": forecaster}
    write_card(file.with_suffix(".md"), "SpreadNetwork of Trapper", facts | {"network": asdict(config)}, tables)
    return file


def spread_loss(forecaster: Forecaster, network: SpreadNetwork, windows: Windows) -> Tensor:
    """Negative log-likelihood of the errors' sizes (logistic in their logarithm), and of being swallowed or not.

    Both are proper scores, averaged over the steps ahead. Errors count until the target is swallowed.
    """
    device = network.head.weight.device
    with torch.no_grad():
        forecast, features, swapped = forecaster.describe(windows.history.to(device))
        error = (forecast - windows.future.to(device))[..., :2].abs() + network.config.finest
    recorded = windows.recorded.to(device)
    log_scale, log_shape, gone = network.raw(features, swapped)
    beyond = log_shape.exp() * (error.log() - log_scale)
    likelihood = log_shape - beyond - 2.0 * softplus(-beyond)
    size = -(likelihood.mean(-1) * recorded).sum() / recorded.sum().clamp_min(1)
    return size + binary_cross_entropy_with_logits(gone, (~recorded).to(gone.dtype))


@torch.no_grad()
def _tables(
    forecaster: Forecaster, network: SpreadNetwork, windows: Windows, scene: TrapperScene, drawing: WindowConfig
) -> dict[str, Rows]:
    forecast, spread = predict(forecaster, network, windows.history)
    tables = {
        "Coverage on held-out windows": coverage(forecast, spread, windows),
        "Swallowed targets": swallowed_odds(spread, windows),
    }
    rows: Rows = []
    for friction in FRICTIONS:
        rolled = rolled_windows(scene, drawing, friction=friction)
        seen = coverage(*predict(forecaster, network, rolled.history), rolled)
        rows += [{"friction": friction} | row for row in seen if row["windows"] == "full"]
    return tables | {f"Coverage at other frictions [N], {ROLLED_VELOCITY:g} m/s, dev episodes": rows}


def predict(forecaster: Forecaster, network: SpreadNetwork, history: Tensor) -> tuple[Tensor, Spread]:
    """Forecasts ``(n, F, 3)`` [m, world] and their spread for histories ``(n, H, 3)``, 1024 at a time, on the CPU."""
    device = network.head.weight.device
    parts: list[Sequence[Tensor]] = []
    for rows in history.split(1024):
        forecast, features, swapped = forecaster.describe(rows.to(device))
        parts.append([forecast.cpu(), *(part.cpu() for part in network(features, swapped))])
    forecast, *spread = (torch.cat(tensors) for tensors in zip(*parts, strict=True))
    return forecast, Spread(*spread)


def rolled_windows(scene: TrapperScene, drawing: WindowConfig, *, friction: float) -> Windows:
    """Windows of `ROLLED` dev episodes at ``friction`` [N], at each of `PRESENTS` that the ball is on the table at."""
    steps = PRESENTS[-1] + drawing.horizon
    shard = roll(
        scene, torch.arange(ROLLED), steps=steps, velocity=ROLLED_VELOCITY, friction=friction, split="dev", seed=0
    )
    paths = Paths(shard["positions"], shard["start"], shard["length"], shard["pocketed"])
    parts = []
    for present in PRESENTS:
        episodes = (paths.length > present + 1).nonzero().squeeze(-1)
        now = torch.full_like(episodes, present)
        parts.append(cut_windows(paths, episodes, now, now.clamp(max=drawing.history), drawing))
    return Windows(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))
