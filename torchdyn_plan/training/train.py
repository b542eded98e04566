"""Trains any network of any task: what `torchdyn-plan train` runs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from torchdyn_plan.errors import InputError
from torchdyn_plan.files import is_file
from torchdyn_plan.tasks.task import NEAREST_ETA, NOISY, Task, load_task


def networks(task: Task) -> tuple[str, ...]:
    """Names of the networks that ``task`` can train: those fitted to data, then its policies."""
    fitted: tuple[str, ...] = ()
    if task.fitting is not None:
        # Paths may come from a file, too.
        fitted += ("forecaster", "spread", f"{NOISY}forecaster", f"{NOISY}spread")
        if task.record_arrivals is not None:
            fitted += ("eta", NEAREST_ETA)
        if task.record_captures is not None:
            fitted += ("capture",)
    return (*fitted, *task.policies)


def train(
    task: Task | str,
    network: str,
    data: Path,
    out: Path,
    *,
    steps: int | None = None,
    batch: int | None = None,
    lr: float | None = None,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = True,
    num_envs: int | None = None,
    num_threads: int = 0,
    workers: int = 0,
    static: str | None = None,
    options: Any = None,
    algorithm: str | None = None,
) -> Path:
    """Train a network, or resume from its folder.

    Args:
        task: whose network, or its name.
        network: ``forecaster``, ``eta``, ``nearest_eta``, ``capture``, ``spread``, ``noisy_forecaster`` and
            ``noisy_spread`` for noisy measurements, or one of the task's policies. A spread is fitted
            to the errors of the forecaster in ``out``, or of the shipped one if there is none.
        data: folder of the collected shards; not used for a policy.
        out: gets a folder of the network's name with checkpoint, curve, weights and card.
        steps: optimiser steps, or rounds for a policy; the recipe's value for None, as for ``batch`` and ``lr``.
        batch: samples per step.
        lr: highest learning rate; for a policy the critic's, with the actor's in the recipe's proportion.
        seed: seed of initialisation, held-out data and draws.
        device: where to train.
        resume: whether to continue from the checkpoint in ``out``.
        num_envs: for a policy: episodes simulated at once; the recipe's value for None.
        num_threads: for a policy: threads of the simulation, 0 for all cores; does not change the result.
        workers: for a policy: Ray workers that run the episodes, 0 for none.
        static: for ``eta``, ``nearest_eta`` and ``capture``: static planner that the data must be of; any for None.
        options: for a policy: an instance of its `PolicyTraining.options`; the defaults for None.
        algorithm: for a policy: ``ddpg`` or ``averaged``; the one of the task's recipe for None.

    Returns:
        The weights' file.

    Raises:
        InputError: the task has no such network, data is missing, damaged or of another scene, or an argument is wrong.
        TrainingError: a loss is NaN, or the checkpoint is damaged or of another recipe.
    """
    from torchdyn_plan.checks import check_choice

    task = load_task(task)
    check_choice(f"network of {task.name}", network, networks(task))
    given = {"batch": batch, "seed": seed}
    if network in task.policies:
        from torchdyn_plan.training.policy import train_policy

        rounds = {"iterations": steps, "num_envs": num_envs}
        machine = {"num_threads": num_threads, "workers": workers, "device": device, "resume": resume}
        return train_policy(
            task, network, out, lr=lr, options=options, algorithm=algorithm, changes=given | rounds, **machine
        )
    _refuse_policy_arguments(network, num_envs=num_envs, workers=workers or None, options=options, algorithm=algorithm)
    from torchdyn_plan.training import fit, fit_spread

    fitting = fit.task_fitting(task)
    own = fitting.recipe("eta" if network == NEAREST_ETA else network)
    recipe = changed(own, steps=steps, lr=lr, device=device, **given)
    kind = network.removeprefix(NOISY)
    if kind != network and fitting.noisy_forecaster is None:
        raise InputError(f"{task.name} has no forecaster for noisy measurements")
    if kind == "forecaster":
        config = fitting.forecaster if kind == network else fitting.noisy_forecaster
        return fit.fit_forecaster(task, data, out, recipe, config=config, resume=resume, name=network)
    if network in ("eta", NEAREST_ETA):
        config = dataclasses.replace(fitting.eta, never=network == "eta")
        return fit.fit_eta(task, data, out, recipe, config=config, static=static, resume=resume, name=network)
    if network == "capture":
        return fit.fit_capture(task, data, out, recipe, static=static, resume=resume)
    noisy = "" if kind == network else NOISY
    beside = out / f"{noisy}forecaster" / "forecaster.safetensors"
    ships = (task.path_weights or task.weights_name) + ("-noisy" if noisy else "")
    forecaster = beside if is_file(beside) else ships
    return fit_spread.fit_spread(task, data, out, recipe, forecaster=forecaster, resume=resume, name=network)


def _refuse_policy_arguments(network: str, **given: Any) -> None:
    for name, value in given.items():
        if value is not None:
            raise InputError(f"{name} is for policies only: {network} has none, got {value!r}")


def changed(recipe: Any, **changes: Any) -> Any:
    """``recipe`` with those ``changes`` that are not None."""
    return dataclasses.replace(recipe, **{name: value for name, value in changes.items() if value is not None})
