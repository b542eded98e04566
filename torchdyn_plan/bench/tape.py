"""A tape of all that MuJoCo is given in a simulation, and MuJoCo alone driven by it."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from mujoco.batch import Batch
from torch import Tensor

STATE = ("qpos", "qvel")
"""Fields that a simulation may write row by row."""
INPUTS = ("ctrl", "mocap_pos", "mocap_quat")
"""Fields that it may write at every step, for all rows."""


class Written(NamedTuple):
    """State that was written from outside since the last call."""

    rows: Tensor
    """``(M,)`` simulations."""
    values: tuple[Tensor, ...]
    """Theirs of `STATE`, ``(M, …)`` each."""


class Call(NamedTuple):
    """A call of a `Batch`, and what was written before it."""

    name: str
    """Of its method; empty where something was written and nothing called."""
    arguments: tuple[Any, ...]
    options: Mapping[str, Any]
    written: Written | None
    """None where no state was written."""
    inputs: tuple[Tensor, ...]
    """All rows of `INPUTS`, of those that the model has; none before a reset, which reads none."""


class TapedBatch:
    """Stands in for a `Batch` and writes down its calls; whatever else it is asked, the batch answers.

    ``seconds`` is the time that writing down has taken so far, which is not the simulation's.
    """

    def __init__(self, batch: Batch) -> None:
        """Tape ``batch``, at first what its state is now."""
        self.batch, self.seconds = batch, 0.0
        self._state, self._inputs = _bound(batch)
        # Not a number differs from everything: all is written at the first call.
        self._known = [torch.full_like(value, torch.nan) for value in self._state]
        self._calls: list[Call] = []

    def __getattr__(self, name: str) -> Any:
        """Whatever else the batch has."""
        return getattr(self.batch, name)

    def step(self, *arguments: Any, **options: Any) -> Any:
        """As `Batch.step`."""
        return self._call("step", arguments, options)

    def forward(self, *arguments: Any, **options: Any) -> Any:
        """As `Batch.forward`."""
        return self._call("forward", arguments, options)

    def reset(self, *arguments: Any, **options: Any) -> Any:
        """As `Batch.reset`."""
        return self._call("reset", arguments, options)

    def take(self) -> list[Call]:
        """The calls since the last time, and what was written after the last of them."""
        self._note("", (), {})
        self._remember()
        calls, self._calls = self._calls, []
        return calls

    def _call(self, name: str, arguments: tuple[Any, ...], options: dict[str, Any]) -> Any:
        self._note(name, arguments, options)
        result = getattr(self.batch, name)(*arguments, **options)
        self._remember()
        return result

    def _remember(self) -> None:
        started = time.perf_counter()
        for known, value in zip(self._known, self._state, strict=True):
            known.copy_(value)
        self.seconds += time.perf_counter() - started

    def _note(self, name: str, arguments: tuple[Any, ...], options: dict[str, Any]) -> None:
        started = time.perf_counter()
        changes = [(value != known).any(-1) for value, known in zip(self._state, self._known, strict=True)]
        rows = torch.stack(changes).any(0).nonzero().squeeze(-1)
        written = Written(rows, tuple(value[rows] for value in self._state)) if len(rows) else None
        # A reset reads no inputs.
        inputs = tuple(value.clone() for value in self._inputs) if name in ("step", "forward") else ()
        if name or written is not None:
            self._calls.append(Call(name, copy.deepcopy(arguments), options, written, inputs))
        self.seconds += time.perf_counter() - started


class RawSimulation:
    """MuJoCo's batch and nothing else, driven by a tape."""

    def __init__(self, taped: TapedBatch) -> None:
        """The same model, copies and threads as ``taped``."""
        of = taped.batch
        self.batch = Batch(of.get_model(0), of.nsim, of.nthread, of.persistent)
        self._state, self._inputs = _bound(self.batch)
        self.qpos = self._state[0]

    def play(self, calls: list[Call]) -> None:
        """Make the calls on the tape."""
        for call in calls:
            if call.written is not None:
                for value, written in zip(self._state, call.written.values, strict=True):
                    value[call.written.rows] = written
            for value, given in zip(self._inputs, call.inputs, strict=False):
                value.copy_(given)
            if call.name:
                getattr(self.batch, call.name)(*call.arguments, **call.options)


def duration(function: Callable[[], object]) -> float:
    """How long a call takes [s]."""
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


def _bound(batch: Batch) -> tuple[list[Tensor], list[Tensor]]:
    """The batch's `STATE` and those of `INPUTS` that its model has, as tensors that share its memory."""
    model = batch.get_model(0)
    sizes = {"ctrl": model.nu, "mocap_pos": model.nmocap, "mocap_quat": model.nmocap}
    state = [torch.from_numpy(batch.bind(name)) for name in STATE]
    return state, [torch.from_numpy(batch.bind(name)) for name in INPUTS if sizes[name]]
