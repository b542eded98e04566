"""What the fits of the two networks differ in from task to task."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from torchdyn_plan.envs.fetch import fetch_digest
from torchdyn_plan.envs.goal_motion import HEIGHT
from torchdyn_plan.envs.scene import TrapperScene
from torchdyn_plan.nets.eta import ETAConfig
from torchdyn_plan.nets.forecaster import ForecasterConfig
from torchdyn_plan.training.arrivals import Arrivals
from torchdyn_plan.training.metrics import AHEAD, FAST, STILL, arrival_groups
from torchdyn_plan.training.windows import WindowConfig

TABLE_GOAL = 0.01
"""A goal less than this above a ball on the table is on the table [m], as `torchdyn_plan.envs.trapping` has it."""


@dataclass(frozen=True, kw_only=True)
class FitTask:
    """A task whose networks are fitted."""

    name: str
    """As on the command line."""
    digest: str
    """Hash of the scene that the data must come from."""
    forecaster: ForecasterConfig
    """Of the forecaster, unless another is asked for."""
    eta: ETAConfig
    """Of the ETA network, unless another is asked for."""
    groups: Callable[[Arrivals], dict[str, Tensor]]
    """Masks ``(n,)`` of the arrivals that are scored together."""
    windows: WindowConfig
    """How windows are drawn; history and horizon are the forecaster's."""
    ahead: tuple[int, ...] = AHEAD
    """Control steps ahead at which forecasts are scored."""
    fast: float = FAST
    """Motion from which a target is fast [m a step]."""
    pockets: bool = True
    """Whether targets can be swallowed, which is scored too."""


def trapper_task(scene: TrapperScene | None = None) -> FitTask:
    """The ball of Trapper and the UR5."""
    scene = scene or TrapperScene()

    def groups(held: Arrivals) -> dict[str, Tensor]:
        rest = held.robot_state[:, 6:12].abs().amax(-1) < STILL
        low = held.goal[:, 2] <= scene.ball_radius + TABLE_GOAL
        return arrival_groups(held.arrival, rest) | {"on table": low, "above table": ~low}

    return FitTask(
        name="trapper",
        digest=scene.digest(),
        forecaster=ForecasterConfig(square_symmetry=True, half_extent=scene.half_side - scene.ball_radius),
        eta=ETAConfig(),
        groups=groups,
        windows=WindowConfig(),
    )


def reach_task() -> FitTask:
    """The goals of Reach, forecast from the first step on, and the Fetch arm, with bins of one step."""

    def groups(held: Arrivals) -> dict[str, Tensor]:
        rest = held.robot_state[:, 5:8].abs().amax(-1) < 1e-3
        level = (held.goal[:, 2] - HEIGHT).abs() < 1e-3
        return arrival_groups(held.arrival, rest) | {"level": level, "elsewhere": ~level}

    return FitTask(
        name="reach",
        digest=fetch_digest(),
        forecaster=ForecasterConfig(
            history=8, horizon=50, channels=16, convolutions=2, hidden=128, rank=32, step_scale=0.05,
            change_scale=1e-4,
        ),
        eta=ETAConfig(robot_state_size=10, tool_slice=(0, 3), bins=50, bin_width=1, hidden=128),
        groups=groups,
        windows=WindowConfig(first_step=0, early_share=0.4, shortened_share=0.3),
        ahead=(5, 20, 50),
        fast=0.02,
        pockets=False,
    )  # fmt: skip


FIT_TASKS: dict[str, Callable[[], FitTask]] = {"trapper": trapper_task, "reach": reach_task}
"""What makes each task, by name."""
