"""The loop that all fits share: a seeded, resumable descent with validation, checkpoints and a curve."""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor, nn

from torchdyn_plan.checks import check_device, check_number, check_seed
from torchdyn_plan.errors import TrainingError
from torchdyn_plan.files import exists, write_json
from torchdyn_plan.progress import progress_bar
from torchdyn_plan.schemas import Count
from torchdyn_plan.stopping import stop_when_safe
from torchdyn_plan.training.checkpoint import load_checkpoint, save_checkpoint


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a network is fitted."""

    steps: int
    """Optimiser steps."""
    batch: int
    """Samples a step."""
    lr: float
    """Highest learning rate, reached after the warm-up; a cosine takes it to zero at the last step."""
    seed: int = 0
    """Seed of initialisation, of the held-out share and of every draw."""
    device: str = "cpu"
    """Where to train."""
    warmup_share: float = 0.03
    """Share of the steps over which the learning rate rises."""
    weight_decay: float = 1e-4
    """AdamW's decay."""
    clip: float = 1.0
    """Greatest norm of a gradient."""
    validations: int = 20
    """Times that the held-out share is scored, the end included."""
    checkpoint_seconds: float = 60.0
    """Time between checkpoints [s]; one is written at each validation too."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "validations"):
            check_number(name, getattr(self, name), minimum=1, integer=True)
        check_seed(self.seed)
        check_number("lr", self.lr, minimum=1e-9)
        check_number("clip", self.clip, minimum=1e-9)
        check_number("warmup_share", self.warmup_share, minimum=0.0, maximum=1.0)
        for name in ("weight_decay", "checkpoint_seconds"):
            check_number(name, getattr(self, name), minimum=0.0)
        check_device(self.device)

    def rate(self, step: int) -> float:
        """Learning rate of step ``step`` (0 … steps-1)."""
        warmup = max(1, round(self.warmup_share * self.steps))
        if step < warmup:
            return self.lr * (step + 1) / warmup
        return self.lr * 0.5 * (1.0 + math.cos(math.pi * (step + 1 - warmup) / max(1, self.steps - warmup)))

    def is_validated(self, step: int) -> bool:
        """Whether the held-out share is scored after ``step`` steps."""
        return step == self.steps or step % max(1, self.steps // self.validations) == 0


class Progress(TypedDict):
    """State of a fit, apart from its tensors."""

    step: Count
    total: float
    """Sum of the losses since the curve's last entry."""
    counted: Count
    """How many these are."""
    curve: list[dict[str, float]]


def optimise(
    network: nn.Module,
    loss: Callable[[torch.Generator], Tensor],
    validate: Callable[[], dict[str, float]],
    recipe: Recipe,
    *,
    out: Path,
    settings: dict[str, Any],
    resume: bool = True,
) -> list[dict[str, float]]:
    """Descend from wherever the checkpoint in ``out`` stands; interrupted or not, the result is the same on a CPU.

    Args:
        network: fitted in place.
        loss: a fresh batch's loss, every draw of it from the generator given.
        validate: figures of the network on the held-out share.
        recipe: steps, rates and seed.
        out: folder of ``checkpoint.safetensors`` and ``curve.json``.
        settings: what besides the recipe must be the same when a checkpoint is continued.
        resume: whether to continue from the checkpoint in ``out``, if there is one.

    Returns:
        The curve: step, mean loss since the last entry, learning rate and validation figures.

    Raises:
        TrainingError: a loss or gradient is NaN or infinite, or the checkpoint is damaged or has other settings.
    """
    descent = _Descent(network=network, loss=loss, validate=validate, recipe=recipe, out=out, settings=settings)
    return descent.run(resume)


class _Descent:
    def __init__(
        self,
        *,
        network: nn.Module,
        loss: Callable[[torch.Generator], Tensor],
        validate: Callable[[], dict[str, float]],
        recipe: Recipe,
        out: Path,
        settings: dict[str, Any],
    ) -> None:
        self.network, self.loss, self.validate, self.recipe = network, loss, validate, recipe
        self.file, self.curve_file = out / "checkpoint.safetensors", out / "curve.json"
        # A checkpoint may be continued on another device, and saved more often.
        free = ("device", "checkpoint_seconds")
        self.settings = settings | {name: value for name, value in asdict(recipe).items() if name not in free}
        decay = recipe.weight_decay
        self.optimiser = torch.optim.AdamW(network.parameters(), lr=recipe.lr, weight_decay=decay, fused=True)
        self.generator = torch.Generator().manual_seed(recipe.seed)
        self.step, self.total, self.counted, self.curve = 0, 0.0, 0, []

    def run(self, resume: bool) -> list[dict[str, float]]:
        if resume and exists(self.file):
            self.restore()
        saved = time.monotonic()
        about: Any = {"total": self.recipe.steps, "initial": self.step, "desc": f"fit {self.file.parent.name}"}
        with stop_when_safe() as stopping, progress_bar(unit="step", **about) as bar:
            while self.step < self.recipe.steps and not stopping():
                self.advance()
                bar.update()
                if self.recipe.is_validated(self.step):
                    self.record()
                    bar.set_postfix({name: f"{value:.4g}" for name, value in self.curve[-1].items() if name != "step"})
                elif not stopping() and time.monotonic() - saved < self.recipe.checkpoint_seconds:
                    continue
                self.save()
                saved = time.monotonic()
        write_json(self.curve_file, self.curve)
        return self.curve

    def advance(self) -> None:
        """One step of the optimiser; nothing changes if the loss or its gradient is NaN or infinite."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.recipe.rate(self.step)
        self.optimiser.zero_grad(set_to_none=True)
        loss = self.loss(self.generator)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.clip)
        value = float(loss.detach())
        if not math.isfinite(value) or not math.isfinite(float(norm)):
            kept = f"the checkpoint {str(self.file)!r} is kept" if exists(self.file) else "there is no checkpoint yet"
            raise TrainingError(
                f"step {self.step + 1} has loss {value:g} and gradient norm {float(norm):g}: {kept}; try a lower lr "
                f"than {self.recipe.lr:g}"
            )
        self.optimiser.step()
        self.step, self.total, self.counted = self.step + 1, self.total + value, self.counted + 1

    def record(self) -> None:
        """Add validation figures to the curve."""
        self.network.eval()
        with torch.no_grad():
            figures = self.validate()
        self.network.train()
        rate = self.recipe.rate(self.step - 1)
        self.curve.append({"step": self.step, "loss": self.total / max(1, self.counted), "lr": rate} | figures)
        self.total, self.counted = 0.0, 0
        write_json(self.curve_file, self.curve)

    def save(self) -> None:
        progress = {"step": self.step, "total": self.total, "counted": self.counted, "curve": self.curve}
        save_checkpoint(
            self.file, self.network, self.optimiser, self.generator, settings=self.settings, progress=progress
        )

    def restore(self) -> None:
        progress: Progress = load_checkpoint(
            self.file, self.network, self.optimiser, self.generator, settings=self.settings, schema=Progress
        )
        self.step, self.total = progress["step"], progress["total"]
        self.counted, self.curve = progress["counted"], progress["curve"]
