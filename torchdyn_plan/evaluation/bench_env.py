"""How much of MuJoCo's rate is left when TorchRL and a planner are in the loop: both measured in turn, on one tape."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from mujoco.batch import Batch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.simulation import TrapperSimulation
from torchdyn_plan.envs.trapper import MAX_STEPS, TrapperEnv
from torchdyn_plan.evaluation.planners import PLANNERS, Planner
from torchdyn_plan.evaluation.play import one_thread, play
from torchdyn_plan.evaluation.run import EpisodeLog
from torchdyn_plan.evaluation.timing import figures
from torchdyn_plan.versions import usable_cores

SIZES = (64, 256, 2048)
"""Environments side by side."""
VELOCITY = 3.0
"""Velocity of the balls at the start [m/s]."""
BLOCK = 50
"""Control steps after which the loop and MuJoCo alone take turns."""


class Reset(NamedTuple):
    """Environments put back before a step, and their state."""

    rows: Tensor
    qpos: Tensor
    qvel: Tensor


class Entry(NamedTuple):
    """What MuJoCo is given in one control step."""

    resets: tuple[Reset, ...]
    ctrl: Tensor
    """Commands of the servos, ``(N, 6)``."""


class TapedSimulation(TrapperSimulation):
    """A simulation that writes down what MuJoCo is given; who reads ``tape`` and ``pending`` empties them."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        """Build the simulation as `TrapperSimulation` does, with an empty tape."""
        super().__init__(*arguments, **settings)
        self.tape: list[Entry] = []
        self.pending: list[Reset] = []

    def reset(self, rows: Tensor, ball_pos: Tensor, ball_vel: Tensor) -> None:
        """Put ``rows`` back and write down their state."""
        super().reset(rows, ball_pos, ball_vel)
        self.pending.append(Reset(rows, self.qpos[rows], self._qvel[rows]))

    def step(self, action: Tensor | None = None, rows: Tensor | None = None) -> None:
        """Step, and write down the servos' commands."""
        super().step(action, rows)
        self.tape.append(Entry(tuple(self.pending), self._ctrl.clone()))
        self.pending.clear()


class RawSimulation:
    """MuJoCo's batch and nothing else, driven by a tape."""

    def __init__(self, taped: TrapperSimulation) -> None:
        """The same scene on as many threads as ``taped``."""
        self.batch = Batch(taped.model, taped.num_envs, taped.batch.nthread, True)
        self.substeps = taped.substeps
        self.qpos, self._qvel, self._ctrl = (
            torch.from_numpy(self.batch.bind(name)) for name in ("qpos", "qvel", "ctrl")
        )

    def put_back(self, resets: Iterable[Reset]) -> None:
        """Reset environments to the states written down."""
        for rows, qpos, qvel in resets:
            self.batch.reset(rows.numpy())
            self.qpos[rows], self._qvel[rows] = qpos, qvel

    def step(self, entry: Entry) -> None:
        """One control step."""
        self.put_back(entry.resets)
        self._ctrl.copy_(entry.ctrl)
        self.batch.step(nstep=self.substeps)


def bench(
    planners: Mapping[str, Callable[[], Planner]] | None = None,
    *,
    sizes: Sequence[int] = SIZES,
    steps: int = MAX_STEPS,
    threads: int = 0,
) -> list[dict[str, Any]]:
    """A row for MuJoCo alone and one for the loop around it, for each size and each way of driving the arms.

    ``share_of_raw`` is MuJoCo's time over the loop's for the same commands; ``max_error`` compares their positions.

    Args:
        planners: makers of planners by name; those of the command line that ship by default.
        sizes: environments side by side.
        steps: control steps of each measurement.
        threads: of the simulation, 0 for all cores.
    """
    from tqdm import tqdm

    makers = planners or {name: lambda name=name: PLANNERS[name]("ik") for name in ("pursuit", "corner")}
    rows = []
    total = len(sizes) * (1 + len(makers)) * steps
    with one_thread(), torch.no_grad(), tqdm(total=total, desc="env", unit="step", leave=False) as bar:
        for size in sizes:
            for what in ("random", *makers):
                env, taped = _taped_env(size, threads)
                loop = _random(env) if what == "random" else play(makers[what](), env, EpisodeLog.empty(10 * size))
                raw, taken, error = _take_turns(loop, taped, steps, bar.update)
                rows += _rows(what, env, raw, taken, error)
    return rows


def _taped_env(size: int, threads: int) -> tuple[TrapperEnv, TapedSimulation]:
    env = TrapperEnv(size, velocity=VELOCITY, split="dev", num_threads=threads)
    env.simulation = taped = TapedSimulation(size, env.scene, num_threads=threads)
    return env, taped


def _random(env: TrapperEnv) -> Iterator[None]:
    """The environment alone, under random actions."""
    actions = torch.rand(64, env.num_envs, 6, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    tensordict: TensorDictBase = env.reset()
    while True:
        for action in actions:
            _, tensordict = env.step_and_maybe_reset(tensordict.set(keys.ACTION, action))
            yield


def _take_turns(
    loop: Iterator[object], taped: TapedSimulation, steps: int, progress: Callable[[int], object]
) -> tuple[list[float], list[float], float]:
    """Durations of each step [s] of MuJoCo alone and of ``loop``, and the greatest difference of their positions."""
    alone, raw, taken, error = RawSimulation(taped), [], [], 0.0
    while len(taken) < steps:
        count = min(BLOCK, steps - len(taken))
        taken += [_duration(next, loop) for _ in range(count)]
        raw += [_duration(alone.step, entry) for entry in taped.tape]
        alone.put_back(taped.pending)
        taped.tape.clear()
        taped.pending.clear()
        error = max(error, float((alone.qpos - taped.qpos).abs().max()))
        progress(count)
    return raw, taken, error


def _duration(function: Callable[[Any], object], argument: object) -> float:
    started = time.perf_counter()
    function(argument)
    return time.perf_counter() - started


def _rows(
    what: str, env: TrapperEnv, raw: Sequence[float], taken: Sequence[float], error: float
) -> list[dict[str, Any]]:
    rows = []
    name = "TrapperEnv" if what == "random" else "evaluation loop"
    for implementation, durations in (("mujoco.batch", raw), (name, taken)):
        about = {
            "what": what, "implementation": implementation, "batch": env.num_envs,
            "threads": env.simulation.batch.nthread or usable_cores(), "compiled": False, "device": "cpu",
        }  # fmt: skip
        rates = {
            "env_steps_per_second": round(env.num_envs * len(durations) / sum(durations)),
            "share_of_raw": round(sum(raw) / sum(durations), 3),
        }
        rows.append(about | figures(durations, env.num_envs) | {"max_error": error} | rates)
    return rows
