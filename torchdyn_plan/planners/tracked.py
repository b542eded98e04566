"""A planner that sees its target through measurements: noisy, late, at any rate, with gaps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchdyn_plan import keys
from torchdyn_plan.checks import check_number, check_points, check_trailing_shape
from torchdyn_plan.errors import InputError
from torchdyn_plan.planners.memory import Remembering, remember, warn_of_loss
from torchdyn_plan.planners.parts import ComposedPlanner
from torchdyn_plan.planners.plan import PlanStatus
from torchdyn_plan.planners.pretrained import PretrainedPlanner
from torchdyn_plan.planners.protocol import keys_written, read
from torchdyn_plan.planners.rows import where_rows
from torchdyn_plan.planners.track import Track, TrackState

NAMES = tuple(f"track_{field}" for field in TrackState._fields)
"""Names of its memory under ``plan``."""
AGE, DEVIATION = "track_age", "track_deviation"
"""Also written, for diagnosis: the age of the newest measurement [s], and the standard deviation of the target's
estimated position along each axis [m]."""
ANY_HISTORY = 24
"""Length of the target's history for planners that accept any length."""
SHOWN = (keys.TARGET_POS, keys.TARGET_HISTORY, keys.TARGET_COVARIANCE)
"""Keys that the inner planner sees from the track instead of from the tensordict."""


class TrackedPlanner(PretrainedPlanner, Remembering):
    """Puts a `Track` between the measurements and a planner, and provides the planner's ``target_pos`` and history.

    Reads ``measured_pos`` (*B, M, D) and ``measured_time`` (*B, M), up to M measurements that arrived since the last
    step; without them, ``target_pos`` counts as a measurement taken now. The planner sees the track's estimate of the
    present position, the positions at past control steps, and the covariance; afterwards these entries are restored.
    Rows without a usable track have `PlanStatus.NO_TRACK` and hold still until there is one. A planner with a second
    forecaster for noisy measurements, `torchdyn_plan.nets.ForecastByNoise`, uses the one that fits the track's noise,
    and plans as soon as there is a track. ``track_restarts`` and ``track_rejected`` under ``plan`` count measurements
    that did not fit.
    """

    def __init__(
        self,
        planner: Callable[[TensorDictBase], TensorDictBase],
        track: Track,
        *,
        control_step: float,
        history: int | None = None,
    ) -> None:
        """Put ``track`` in front of ``planner``.

        Args:
            planner: any planner for a moving target.
            track: the filter of the measurements.
            control_step: time between two steps [s].
            history: length H of the target's history. None for the length that the planner's forecaster reads, or 24
                if it accepts any length or reads no history.
        """
        super().__init__()
        check_number("control_step", control_step, minimum=1e-6)
        if isinstance(planner, ComposedPlanner) and isinstance(track, Track):
            planner = planner.for_noise(track.noise)
        read_by_forecaster: int = getattr(getattr(planner, "forecaster", None), "history", None) or ANY_HISTORY
        length = read_by_forecaster if history is None else history
        check_number("history", length, minimum=2, integer=True)
        if not isinstance(track, Track):
            raise InputError(f"track must be a Track such as KalmanTrack(), got {type(track).__name__}")
        if not isinstance(planner, TensorDictModuleBase):
            raise InputError(f"planner must be a planner of this package, got {type(planner).__name__}")
        self.planner, self.track, self.control_step, self.history = planner, track, control_step, length
        own: list[Any] = [(keys.PLAN, name) for name in NAMES]
        seen = [key for key in planner.in_keys if key not in SHOWN]
        read_keys: list[Any] = list(dict.fromkeys([keys.TARGET_POS, keys.STEP_COUNT, *seen, *own]))
        self.in_keys = read_keys
        reported = [(keys.PLAN, name) for name in (AGE, DEVIATION)]
        self.out_keys = keys_written(planner, *own, *reported)

    @property
    def scene(self) -> str | None:
        """Digest of the planner's scene."""
        return getattr(self.planner, "scene", None)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Update the track with the measurements, and run the planner on it."""
        like, step_count = read(tensordict, keys.TARGET_POS, "TrackedPlanner"), read(tensordict, keys.STEP_COUNT, "")
        check_points(keys.TARGET_POS, like)
        step_count = step_count.reshape(like.shape[:-1])
        now = step_count.to(like.dtype) * self.control_step
        state = self._measure(self._recall(tensordict, like, step_count), tensordict, like, now)
        present, usable = self.track.at(state, now), self.track.usable(state, now)
        original = {key: tensordict.get(key, None) for key in SHOWN}
        for key, value in zip(SHOWN, self._shown(state, present, usable, now), strict=True):
            tensordict.set(key, value)
        tensordict = self.planner(tensordict)
        for key, value in original.items():
            _restore(tensordict, key, value)
        self._report(tensordict, state, present, usable, now)
        return tensordict

    def empty_memory(self, like: Tensor) -> dict[str, Tensor]:
        """The memory of the track and of the planner, see `Remembering`."""
        inner = self.planner.empty_memory(like) if isinstance(self.planner, Remembering) else {}
        return dict(zip(NAMES, self.track.start(like), strict=True)) | inner

    def part_settings(self) -> dict[str, Any]:
        """Constructor arguments of this planner."""
        names = ("planner", "track", "control_step", "history")
        return {name: getattr(self, name) for name in names}

    def with_planner(self, planner: Callable[[TensorDictBase], TensorDictBase]) -> Self:
        """The same track in front of another planner."""
        settings: dict[str, Any] = self.part_settings() | {"planner": planner}
        return type(self)(**settings).train(self.training)

    def for_inference(self) -> Self:
        """A copy with the planner's current networks prepared for inference, in as few operations as possible."""
        fast = getattr(self.planner, "for_inference", None)
        return self if fast is None else self.with_planner(fast())

    def _recall(self, tensordict: TensorDictBase, like: Tensor, step_count: Tensor) -> TrackState:
        """The state after the last step; rows at step 0, and those whose memory holds a NaN, restart."""
        start, plan = self.track.start(like), tensordict.get(keys.PLAN, None)
        stored: dict[str, Any] = {} if plan is None else dict(plan.items())
        if any(name not in stored for name in NAMES):
            warn_of_loss(NAMES[0], step_count == 0)
            return start
        state = TrackState(*(stored[name] for name in NAMES))
        fresh = (step_count == 0) | state.motion.isnan().any(-1) | state.time.isnan()
        return TrackState(*(where_rows(fresh, new, old) for new, old in zip(start, state, strict=True)))

    def _measure(self, state: TrackState, tensordict: TensorDictBase, target_pos: Tensor, now: Tensor) -> TrackState:
        """The state after the measurements of this step."""
        pos, time = tensordict.get(keys.MEASURED_POS, None), tensordict.get(keys.MEASURED_TIME, None)
        if pos is None or time is None:
            return self.track.add(state, now, target_pos, now)
        check_trailing_shape(keys.MEASURED_POS, pos, *time.shape, target_pos.shape[-1])
        for slot in range(time.shape[-1]):
            state = self.track.add(state, time[..., slot], pos[..., slot, :], now)
        return state

    def _shown(self, state: TrackState, present: TrackState, usable: Tensor, now: Tensor) -> tuple[Tensor, ...]:
        """What the planner sees, in the order of `SHOWN`; NaN in rows without a usable track."""
        ago = self.control_step * torch.arange(1 - self.history, 1, dtype=now.dtype, device=now.device)
        history = where_rows(
            usable, state.path(now.unsqueeze(-1) + ago), torch.full_like(now, torch.nan)[..., None, None]
        )
        covariance = where_rows(usable, present.covariance, torch.zeros_like(now)[..., None, None])
        return history[..., -1, :], history, covariance

    def _report(
        self, tensordict: TensorDictBase, state: TrackState, present: TrackState, usable: Tensor, now: Tensor
    ) -> None:
        deviation = present.covariance[..., 0, 0].sqrt()
        entries = dict(zip(NAMES, state, strict=True)) | {AGE: now - state.time, DEVIATION: deviation}
        plan = tensordict.get(keys.PLAN, None)
        status = None if plan is None else plan.get("status", None)
        if status is not None:
            entries["status"] = status.masked_fill(~usable, int(PlanStatus.NO_TRACK))
        remember(tensordict, entries)


def _restore(tensordict: TensorDictBase, key: str, value: Tensor | None) -> None:
    """Set ``key`` back to ``value``, or remove it if it was not there before."""
    if value is not None:
        tensordict.set(key, value)
    elif key in tensordict.keys():  # noqa: SIM118
        tensordict.pop(key)
