"""The evaluation loop for any task: environment, planner, and a log of the episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.envs.moving_target import MovingTargetEnv
from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.evaluation.results import NO_CAUSE, TRACK, TRACK_COUNTS, EpisodeOutcomes
from torchdyn_plan.evaluation.traces import Trace, TraceLog, true_target
from torchdyn_plan.progress import progress_bar
from torchdyn_plan.tasks.task import Task, Truth, Verdict

Planner = Callable[[TensorDictBase], TensorDictBase]
"""Anything that writes ``action`` into a tensordict of observations, and returns it. A planner that reads the truth
declares ``target_future`` or ``true_future`` in its ``in_keys``."""
OFF_PATH = 0.002
"""A target this far off its path has been touched [m]."""
RENEWED_EVERY = 5
"""Control steps after which the future of a target in contact is simulated again."""


@dataclass(kw_only=True)
class EpisodeLog:
    """State of each of E episodes so far; every tensor is ``(E,)``."""

    success_flag: str
    """The environment's flag of success."""
    done: Tensor
    """Which episodes have ended, bool."""
    steps: Tensor
    """First control step at which the success flag was true, int64; -1 for none."""
    replans: Tensor
    """Number of plans, int64, for episodes that have ended."""
    track: dict[str, Tensor] = field(default_factory=dict)
    """Counts of the planner's track, int64, for episodes that have ended; empty for a planner without a track."""
    flags: dict[str, Tensor]
    """The environment's other flags when the episode ended, bool, by name."""
    traces: TraceLog | None
    """Step-by-step records; None if they are not needed."""
    order: list[Tensor]
    """Numbers of the episodes in the order in which they ended."""

    @classmethod
    def empty(cls, count: int, task: Task, env: MovingTargetEnv) -> EpisodeLog:
        """An empty log for ``count`` episodes of ``task`` in ``env``; with traces if the task's verdict needs them."""
        no = torch.zeros(count, dtype=torch.bool)
        others = [flag for flag in env.flags if flag != task.words.success]
        return cls(
            success_flag=task.words.success,
            done=no,
            steps=torch.full((count,), -1),
            replans=torch.zeros(count, dtype=torch.int64),
            flags={flag: no.clone() for flag in others},
            traces=None if task.judge is None else TraceLog(env.max_steps),
            order=[],
        )

    @property
    def success(self) -> Tensor:
        """Which episodes were a success, bool."""
        return self.steps >= 0

    def add(self, stepped: TensorDictBase) -> int:
        """Add one step of all environments; returns how many episodes it ended. Later steps of those are ignored."""
        if self.traces is not None:
            self.traces.add(stepped)
        after: TensorDictBase = stepped.get("next")
        done, success = after["done"].squeeze(-1), after[self.success_flag].squeeze(-1)
        noted = done | success
        if not noted.any():
            return 0
        episode = after[keys.EPISODE]
        counts = episode < len(self.done)
        counts[counts.clone()] = ~self.done[episode[counts]]
        rows = (noted & counts).nonzero().squeeze(-1)
        first = rows[success[rows] & (self.steps[episode[rows]] < 0)]
        self.steps[episode[first]] = after[keys.STEP_COUNT].squeeze(-1)[first]
        ended = rows[done[rows]]
        if len(ended):
            self._end(stepped, ended)
        return len(ended)

    def _end(self, stepped: TensorDictBase, rows: Tensor) -> None:
        """Close the episodes of environments ``rows`` (R,), which end with this step."""
        after: TensorDictBase = stepped.get("next")
        episode = after[keys.EPISODE][rows]
        self.done[episode] = True
        for name, flag in self.flags.items():
            flag[episode] = after[name].squeeze(-1)[rows]
        replans = stepped.get((keys.PLAN, "replans"), None)
        self.replans[episode] = 0 if replans is None else replans[rows]
        for name in (f"{TRACK}{count}" for count in TRACK_COUNTS):
            counted = stepped.get((keys.PLAN, name), None)
            if counted is not None:
                self.track.setdefault(name, torch.zeros_like(self.replans))[episode] = counted[rows]
        if self.traces is not None:
            self.traces.end(stepped, rows)
        self.order.append(episode)

    def records(self) -> Iterator[tuple[Tensor, Trace]]:
        """Records of all episodes that have ended, in blocks: their numbers ``(R,)`` and their `Trace`."""
        begin = 0
        for trace in [] if self.traces is None else self.traces.traces():
            count = len(trace.length)
            yield torch.cat(self.order)[begin : begin + count], trace
            begin += count


class ShownTruth:
    """The truth for planners that read it: recordings, and futures simulated from the present state."""

    def __init__(self, planner: Planner, env: MovingTargetEnv, recorded: Tensor | None) -> None:
        """Write the true paths that ``planner`` reads into ``env``, from ``recorded`` (E, T, D); nothing for None."""
        read = getattr(planner, "in_keys", ())
        known = recorded if recorded is not None and recorded.shape[1] else None
        self.env, self.recorded = env, known
        self.shows_recording = known is not None and keys.TARGET_FUTURE in read
        self.shows_future = known is not None and keys.TRUE_FUTURE in read
        # The path of each row; the recorded one for episodes that have just started.
        self._path, self._episode = None, torch.full((env.num_envs,), -1)

    def show(self, tensordict: TensorDictBase) -> None:
        """Write the truth that the planner reads into ``tensordict``."""
        if self.recorded is None:
            return
        episode = tensordict[keys.EPISODE].clamp(max=len(self.recorded) - 1)
        if self.shows_recording:
            tensordict[keys.TARGET_FUTURE] = self.recorded[episode]
        if self.shows_future:
            tensordict[keys.TRUE_FUTURE] = self._future(episode, tensordict)

    def _future(self, episode: Tensor, seen: TensorDictBase) -> Tensor:
        """Future positions of the targets, ``(N, F, D)``; F is how far recordings extend beyond an episode."""
        assert self.recorded is not None
        new, step = episode != self._episode, seen[keys.STEP_COUNT].squeeze(-1)
        if self._path is None:
            self._path = self.recorded[episode].clone()
        self._path[new], self._episode = self.recorded[episode[new]], episode.clone()
        rows, length = torch.arange(len(step)), self._path.shape[1]
        off = (self._path[rows, step] - true_target(seen)).norm(dim=-1) > OFF_PATH
        # Episodes beyond the recorded ones run until the others have ended, and are not counted.
        counts = seen[keys.EPISODE] < len(self.recorded)
        stale = (off & counts & (step % RENEWED_EVERY == 0)).nonzero().squeeze(-1)
        if len(stale):
            # As far as the row with the most remaining steps needs it.
            steps = length - 1 - int(step[stale].min())
            since = torch.arange(length) - step[stale].unsqueeze(-1) - 1
            index = since.clamp(0, steps - 1).unsqueeze(-1).expand(-1, -1, self._path.shape[-1])
            renewed = self.env.true_future(stale, steps).gather(1, index)
            self._path[stale] = torch.where(since.unsqueeze(-1) >= 0, renewed, self._path[stale])
        ahead = torch.arange(1, length - self.env.max_steps)
        return self._path.gather(1, (step.unsqueeze(-1) + ahead).unsqueeze(-1).expand(-1, -1, self._path.shape[-1]))


def play(planner: Planner, env: MovingTargetEnv, log: EpisodeLog, future: Tensor | None = None) -> Iterator[int]:
    """Step all environments once for each value taken, which is the number of ``log``'s episodes that the step ended.

    ``future`` (E, T, D) is the recorded truth for planners that read ``target_future`` or ``true_future``; None or T =
    0 for none.
    """
    truth, tensordict = ShownTruth(planner, env, future), env.reset()
    while True:
        truth.show(tensordict)
        stepped, tensordict = env.step_and_maybe_reset(planner(tensordict))
        yield log.add(stepped)


def play_all(
    planner: Planner, env: MovingTargetEnv, log: EpisodeLog, future: Tensor | None, *, name: str, progress: bool = True
) -> float:
    """Play until all of ``log``'s episodes have ended; an environment takes the next episode when its own ends.

    Args:
        planner: any planner for a moving target.
        env: what it acts in, at its first episode.
        log: of the episodes to come.
        future: ``(E, T, D)`` recorded truth, see `play`.
        name: shown with the progress bar.
        progress: show the bar.

    Returns:
        How long it took [s].
    """
    count, started, ended = len(log.done), time.perf_counter(), 0
    with (
        torch.no_grad(),
        progress_bar(total=count, desc=name, unit="episode", leave=False, disable=not progress) as bar,
    ):
        for more in play(planner, env, log, future):
            bar.update(more)
            ended += more
            if ended >= count:
                break
    return time.perf_counter() - started


def find_truth(
    task: Task, settings: Any, *, episodes: int, seed: int, split: str, static: str | None = None, num_threads: int = 0
) -> Truth:
    """Truth about episodes 0 … E-1 before they are played, for the static planner of that name.

    For a task without such knowledge all episodes count as solvable, and their future has T = 0 steps.
    """
    if task.truth is None:
        return Truth(torch.empty(episodes, 0, 3), torch.ones(episodes, dtype=torch.bool))
    name = static or task.default_static
    return task.truth(settings, episodes=episodes, seed=seed, split=split, static=name, num_threads=num_threads)


def run_episodes(
    planner: Planner,
    task: Task,
    settings: Any,
    truth: Truth,
    *,
    episodes: int,
    seed: int = 0,
    split: str = "test",
    num_envs: int = 64,
    num_threads: int = 0,
    sensor: Sensor | None = None,
    name: str = "",
    progress: bool = True,
) -> EpisodeOutcomes:
    """Outcomes of episodes 0 … E-1 under ``planner``.

    Args:
        planner: any planner for a moving target.
        task: whose environment it acts in.
        settings: the task's.
        truth: of these episodes, as of `find_truth`.
        episodes: their number E.
        seed: which series of episodes.
        split: which family of series.
        num_envs: episodes that run in parallel; does not change the outcomes.
        num_threads: of the simulation, 0 for all cores; does not change the outcomes.
        sensor: how targets are measured; exactly for None.
        name: shown with the progress bar.
        progress: show the bar.
    """
    batch: dict[str, Any] = {"num_envs": min(num_envs, episodes), "seed": seed, "split": split}
    if sensor is not None and not sensor.is_exact:
        # A task must support sensors only if one is given.
        batch["sensor"] = sensor
    env = task.make_env(settings, num_threads=num_threads, **batch)
    log = EpisodeLog.empty(episodes, task, env)
    seconds = play_all(planner, env, log, truth.future, name=name, progress=progress)
    verdict = _judge(task, settings, log, truth)
    return EpisodeOutcomes(
        success=log.success,
        steps=log.steps,
        replans=log.replans,
        solvable=truth.solvable,
        flags=log.flags | dict(verdict.flags),
        evidence=dict(verdict.evidence) | log.track,
        cause=verdict.cause,
        causes=task.causes,
        seconds=seconds,
    )


def _judge(task: Task, settings: Any, log: EpisodeLog, truth: Truth) -> Verdict:
    """The task's verdict; without one, no episode has a cause."""
    if task.judge is None:
        return Verdict(torch.full((len(log.done),), NO_CAUSE), {}, {})
    return task.judge(settings, log, truth)
