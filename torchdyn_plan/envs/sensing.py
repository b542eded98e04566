"""Simulated measurements of a batch of targets; an episode's measurements do not depend on the batch."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdyn_plan.envs.episodes import episode_random
from torchdyn_plan.envs.sensor import Sensor

STREAM = 2
"""An episode's stream of random numbers for its sensor."""
LOST = torch.iinfo(torch.int64).max
"""Arrival step of a lost measurement."""
ROUNDING = 1e-9
"""Share of a control step treated as rounding error."""


class Sensed(NamedTuple):
    """Measurements of N targets available at one control step."""

    held: Tensor
    """``(N, D)`` float32, the newest measurement available [m, world]."""
    pos: Tensor
    """``(N, M, D)`` float32 measurements that arrive at this step [m, world]; NaN in empty slots."""
    time: Tensor
    """``(N, M)`` float32, their time stamps [s since the reset]; NaN in empty slots."""


class Sensing:
    """The sensors of N environments, with measurements that have not arrived yet.

    All random numbers of an episode's measurements are drawn when it starts, as a pure function of (split, seed,
    episode), so that results do not depend on the number of environments.
    """

    def __init__(
        self, sensor: Sensor, num_envs: int, *, coordinates: int = 3, control_step: float, max_steps: int
    ) -> None:
        """Allocate memory for episodes of up to ``max_steps`` control steps of ``control_step`` [s].

        Positions have ``coordinates`` D.
        """
        self.sensor, self.control_step = sensor, control_step
        self.slots = sensor.slots(control_step)
        self._period = control_step if sensor.rate is None else 1.0 / sensor.rate
        self._count = math.floor(max_steps * control_step / self._period + ROUNDING) + 1
        shape = num_envs, self._count
        self._time = torch.zeros(shape, dtype=torch.float64)
        self._error = torch.zeros(*shape, coordinates)
        self._value = torch.zeros(*shape, coordinates)
        self._taken_step = torch.zeros(shape, dtype=torch.int64)
        self._seen_step = torch.zeros(shape, dtype=torch.int64)
        self._held = torch.zeros(num_envs, coordinates)

    def nothing(self) -> Sensed:
        """The result before any measurement."""
        shape = len(self._held), self.slots
        return Sensed(
            self._held.clone(), torch.full((*shape, self._held.shape[-1]), torch.nan), torch.full(shape, torch.nan)
        )

    def start(self, rows: Tensor, episodes: Tensor, place: Tensor, *, split: str, seed: int) -> Sensed:
        """Start ``episodes`` (R,) in ``rows`` (R,) with targets at ``place`` (R, D); returns the first measurements."""
        for row, episode in zip(rows.tolist(), episodes.tolist(), strict=True):
            self._draw(row, episode_random(split, seed, episode, STREAM))
        # Jitter may take more than one measurement at the start.
        early = self._taken_step[rows] == 0
        which, number = early.nonzero(as_tuple=True)
        self._value[rows[which], number] = self._measured(place[which], self._error[rows[which], number])
        self._held[rows] = self._value[rows, 0]
        comes = torch.zeros_like(self._taken_step, dtype=torch.bool)
        comes[rows] = self._seen_step[rows] == 0
        return Sensed(*(value[rows] for value in self._shown(comes)))

    def _draw(self, row: int, draw: np.random.Generator) -> None:
        """Draw times, errors and losses of all measurements of the episode that starts in ``row``."""
        sensor, count = self.sensor, self._count
        self._error[row] = torch.from_numpy(sensor.noise * draw.standard_normal((count, self._held.shape[-1]))).float()
        moment = self._period * np.arange(count) + sensor.jitter * draw.standard_normal(count)
        lost = torch.from_numpy(draw.uniform(size=count) < sensor.dropout)
        moment[0], lost[0] = 0.0, False
        self._time[row] = torch.from_numpy(np.sort(moment.clip(min=0.0)))
        self._taken_step[row] = self._step_of(self._time[row])
        self._seen_step[row] = self._step_of(self._time[row] + sensor.latency).masked_fill(lost, LOST)
        self._seen_step[row, 0] = 0

    def see(self, step_count: Tensor, before: Tensor, now: Tensor) -> Sensed:
        """Measurements available at ``step_count`` (N,), for targets moving from ``before`` to ``now`` (N, D)."""
        step = step_count.unsqueeze(-1)
        rows, number = ((self._taken_step == step) & (step > 0)).nonzero(as_tuple=True)
        # A measurement between two control steps is interpolated between the two positions.
        share = 1.0 - (step_count[rows] - self._time[rows, number] / self.control_step)
        share = share.masked_fill(share > 1.0 - ROUNDING, 1.0).float().unsqueeze(-1)
        place = torch.lerp(before[rows], now[rows], share)
        self._value[rows, number] = self._measured(place, self._error[rows, number])
        return self._shown(self._seen_step == step)

    def _shown(self, comes: Tensor) -> Sensed:
        """The measurements that arrive now, ``(N, count)`` bool, the last ``slots`` of each row."""
        left = comes.long().flip(-1).cumsum(-1).flip(-1)
        rows, number = (comes & (left <= self.slots)).nonzero(as_tuple=True)
        pos = torch.full((len(comes), self.slots, self._held.shape[-1]), torch.nan)
        time = torch.full((len(comes), self.slots), torch.nan)
        slot = self.slots - left[rows, number]
        pos[rows, slot], time[rows, slot] = self._value[rows, number], self._time[rows, number].float()
        came = comes.any(-1)
        self._held[came] = pos[came, -1]
        return Sensed(self._held.clone(), pos, time)

    def _step_of(self, time: Tensor) -> Tensor:
        """The first control step at or after ``time`` [s], int64."""
        return torch.ceil(time / self.control_step - ROUNDING).long()

    def _measured(self, place: Tensor, error: Tensor) -> Tensor:
        value, grain = place + error, self.sensor.quantisation
        return torch.round(value / grain) * grain if grain else value
