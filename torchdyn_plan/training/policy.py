"""Training of a policy: rounds of DDPG with scores, logs and checkpoints; resumes exactly."""

from __future__ import annotations

import copy
import csv
import io
import json
import logging
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypedDict

import torch

from torchdyn_plan.checks import MOST_THREADS, check_choice, check_count, check_number, check_threads
from torchdyn_plan.errors import InputError, TrainingError
from torchdyn_plan.files import exists, short_path, write_whole
from torchdyn_plan.nets.policy import Actor
from torchdyn_plan.progress import progress_bar
from torchdyn_plan.schemas import Count
from torchdyn_plan.stopping import stop_when_safe
from torchdyn_plan.tasks.task import Task
from torchdyn_plan.threads import one_thread
from torchdyn_plan.training.algorithms import learner_type, recipe_for
from torchdyn_plan.training.card import write_card
from torchdyn_plan.training.checkpoint import group, read_checkpoint, write_checkpoint
from torchdyn_plan.training.ddpg import DDPG
from torchdyn_plan.training.goal_task import DDPGRecipe, GoalTask


def train_policy(
    task: Task,
    name: str,
    out: Path,
    *,
    lr: float | None = None,
    options: Any = None,
    changes: Mapping[str, Any] | None = None,
    algorithm: str | None = None,
    resume: bool = True,
    num_threads: int = 0,
    workers: int = 0,
    device: str = "cpu",
) -> Path:
    """Train the policy ``name`` of ``task`` by its own recipe; returns the weights' file.

    Args:
        task: the task.
        name: one of ``task.policies``.
        out: see `fit_policy`.
        lr: the critic's learning rate, with the actor's in the recipe's proportion; the recipe's own for None.
        options: an instance of the `PolicyTraining.options`; the defaults for None.
        algorithm: one of `ALGORITHMS`; the recipe's own for None.
        changes: fields of the recipe to change; those that are None stay unchanged.
        resume: see `fit_policy`, as for ``workers`` and ``device``.
        num_threads: of the simulation, 0 for all cores.
        workers: Ray workers.
        device: where networks learn.

    Raises:
        InputError: there is no such policy, or the options have the wrong type.
        TrainingError: see `fit_policy`.
    """
    check_choice(f"policy of {task.name}", name, task.policies)
    training = task.policies[name]
    options = training.options() if options is None else options
    check_threads("num_threads", num_threads)
    check_count("workers", workers, minimum=0, maximum=MOST_THREADS)
    if not isinstance(options, training.options):
        raise InputError(f"options of {name} must be {training.options.__name__}, got {type(options).__name__}")
    recipe: DDPGRecipe = training.recipe()
    if algorithm is not None:
        recipe = recipe_for(algorithm, recipe)
    if lr is not None:
        recipe = recipe.with_rate(lr)
    recipe = replace(recipe, **{field: value for field, value in (changes or {}).items() if value is not None})
    return fit_policy(
        training.goal_task(options, num_threads=num_threads),
        out,
        name=name,
        recipe=recipe,
        resume=resume,
        score_every=training.score_every,
        workers=workers,
        device=device,
    )


def fit_policy(
    task: GoalTask,
    out: Path,
    *,
    name: str = Actor.kind,
    recipe: DDPGRecipe | None = None,
    resume: bool = True,
    score_every: int = 20,
    checkpoint_seconds: float = 60.0,
    workers: int = 0,
    device: str = "cpu",
) -> Path:
    """Train a policy for ``task`` by `DDPG`; the one with the best score is kept.

    A run that is killed at any time and resumed gives the same result as an uninterrupted one: rounds are whole
    episodes of every environment, and networks, optimisers, replay, counters and random states are in the checkpoint.

    Args:
        task: goals, rewards and score.
        out: gets a folder ``name`` with checkpoint, ``curve.csv``, TensorBoard's files, weights and card.
        name: name of the folder.
        recipe: rounds, rates and seed.
        resume: whether to continue from the checkpoint in ``out``.
        score_every: rounds between scores.
        checkpoint_seconds: time between checkpoints [s].
        workers: Ray workers that run the episodes; 0 runs them here.
        device: where networks learn; the simulation stays on the CPU.

    Returns:
        The weights' file.

    Raises:
        TrainingError: a loss is NaN, or the checkpoint is damaged, of another task, or has other settings.
    """
    check_number("score_every", score_every, minimum=1, integer=True)
    # TorchRL logs every storage it makes, which breaks the progress bar.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    recipe = recipe or DDPGRecipe()
    with one_thread():
        training = _Training(task, out / name, recipe, score_every=score_every, workers=workers, device=device)
        return training.run(resume, checkpoint_seconds)


class Learner(TypedDict):
    """Progress of `DDPG`."""

    iteration: Count
    cursor: Count
    episode: Count


class Progress(TypedDict):
    """State of a training, without its tensors."""

    curve: list[dict[str, float]]
    best: dict[str, float]
    seconds: float
    ddpg: Learner


class _Training:
    def __init__(
        self, task: GoalTask, folder: Path, recipe: DDPGRecipe, *, score_every: int, workers: int, device: str
    ) -> None:
        self.task, self.folder, self.recipe = task, folder, recipe
        self.score_every, self.workers, self.device = score_every, workers, device
        self.file, self.weights = folder / "checkpoint.safetensors", folder / f"{Actor.kind}.safetensors"
        self.settings = task.settings() | {"algorithm": recipe.algorithm, "recipe": asdict(recipe)}
        self.settings |= {"score_every": score_every}
        self.settings |= {"workers": workers} if workers else {}
        self.curve: list[dict[str, float]] = []
        self.best: dict[str, float] = {}
        self.seconds = 0.0

    def run(self, resume: bool, checkpoint_seconds: float) -> Path:
        tensors, progress = {}, {}
        if resume and exists(self.file):
            tensors, progress = read_checkpoint(self.file, settings=self.settings, schema=Progress)
        self.ddpg = self.learner()
        self.best_actor = Actor(self.task.policy_config)
        if progress:
            self.restore(tensors, progress)
        log = _TensorBoard(self.folder, self.ddpg.iteration)
        saved = started = time.monotonic()
        rounds = self.recipe.iterations
        about: Any = {"total": rounds, "initial": self.ddpg.iteration, "desc": "fit policy", "unit": "round"}
        with stop_when_safe() as stopping, progress_bar(**about) as bar:
            while self.ddpg.iteration < rounds and not stopping():
                figures = self.ddpg.iterate()
                bar.update()
                scored = self.ddpg.iteration % self.score_every == 0 or self.ddpg.iteration == rounds
                if scored:
                    self.seconds, started = self.seconds + time.monotonic() - started, time.monotonic()
                    bar.set_postfix({name: f"{value:.3g}" for name, value in self.score(figures, log).items()})
                if scored or stopping() or time.monotonic() - saved > checkpoint_seconds:
                    self.seconds, started = self.seconds + time.monotonic() - started, time.monotonic()
                    self.save()
                    saved = time.monotonic()
        self.ddpg.close()
        self.write_card()
        return self.weights

    def learner(self) -> DDPG:
        kind = learner_type(self.recipe.algorithm)
        if self.workers == 0:
            return kind(self.task, self.recipe, device=self.device)
        try:
            from torchdyn_plan.training.cluster import on_cluster
        except ImportError as error:
            raise InputError("workers need Ray: pip install 'torchdyn-plan[ray]'") from error
        return on_cluster(kind)(self.task, self.recipe, workers=self.workers, device=self.device)

    def score(self, figures: dict[str, float], log: _TensorBoard) -> dict[str, float]:
        """Score the policy, add a row to the curve, and keep the policy if it is the best so far."""
        transitions = self.ddpg.iteration * self.recipe.num_envs * self.task.length
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            score = self.task.score(copy.deepcopy(self.ddpg.learned).cpu())
        place = {"round": self.ddpg.iteration, "transitions": transitions, "seconds": round(self.seconds, 1)}
        self.curve.append(place | figures | score)
        log.add(self.curve[-1], self.ddpg.iteration)
        write_curve(self.folder / "curve.csv", self.curve)
        if not self.best or _rank(score) >= _rank(self.best):
            self.best = score | {"round": self.ddpg.iteration}
            self.best_actor.load_state_dict(self.ddpg.learned.state_dict())
            self.best_actor.save_pretrained(self.weights)
        return score | {"best": self.best["success"]}

    def save(self) -> None:
        tensors = self.ddpg.tensors()
        tensors |= {f"best.{name}": value for name, value in self.best_actor.state_dict().items()}
        progress = {"curve": self.curve, "best": self.best, "seconds": self.seconds, "ddpg": self.ddpg.progress()}
        write_checkpoint(self.file, tensors, settings=self.settings, progress=progress)

    def restore(self, tensors: dict[str, torch.Tensor], progress: dict[str, Any]) -> None:
        try:
            self.ddpg.restore(tensors, progress["ddpg"])
            self.best_actor.load_state_dict(group(tensors, "best"))
        except (KeyError, ValueError, TypeError, RuntimeError, IndexError, StopIteration) as error:
            raise TrainingError(f"checkpoint {short_path(self.file)} does not fit: {error!r}") from error
        self.curve, self.best, self.seconds = progress["curve"], progress["best"], progress["seconds"]

    def write_card(self) -> None:
        settings = json.loads(json.dumps(self.settings))
        facts = settings | {"best": self.best, "hours": self.seconds / 3600.0}
        rows = self.curve[:: max(1, len(self.curve) // 20)]
        names = ("round", "transitions", "seconds", "success", "steps")
        table = [{name: row[name] for name in names if name in row} for row in rows]
        write_card(self.folder / f"{Actor.kind}.md", "Policy", facts, {"Curve": table})


def _rank(score: dict[str, float]) -> tuple[float, float]:
    """Higher is better: the share of successes, then the speed."""
    return score["success"], -score.get("steps", 0.0)


def write_curve(file: Path, curve: list[dict[str, float]]) -> None:
    """Write rows of figures as CSV, atomically; the columns are those of the last row."""
    text = io.StringIO()
    table = csv.DictWriter(text, fieldnames=list(curve[-1]), restval="", extrasaction="ignore")
    table.writeheader()
    table.writerows(curve)
    write_whole(file, lambda temporary: temporary.write_text(text.getvalue()))


class _TensorBoard:
    """TensorBoard's log, if the library is installed."""

    def __init__(self, folder: Path, step: int) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter

            self.writer = SummaryWriter(str(folder), purge_step=step)
        except (ImportError, OSError):
            # A failing log, for example on a full disk, does not end the training.
            self.writer = None

    def add(self, figures: dict[str, float], step: int) -> None:
        """Log ``figures`` at ``step``."""
        if self.writer is not None:
            try:
                for name, value in figures.items():
                    self.writer.add_scalar(name, value, step)
                self.writer.flush()
            except OSError:
                self.writer = None
