"""Forecast and arrival without any training: the billiard's mechanics, and the limits of the arm's joints."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchdyn_plan.nets.analytic import Billiard
from torchdyn_plan.nets.analytic_arrival import AnalyticArrival

if TYPE_CHECKING:
    from torchdyn_plan.envs.trapper.scene import TrapperScene
    from torchdyn_plan.planners import IKPlanner, PaceAndPath

GIVE = 0.012
"""How far a ball presses a cushion in before it turns back [m]."""
RESTITUTION, RESTITUTION_DEVIATION = 0.92, 0.03
"""Share of the speed across a cushion that comes back, and how much that differs; read off rolls of the split train."""
SLIDING = 0.45
"""Deceleration of a ball that has bounced, whose spin is still that of before [m/s²]; about the cloth's friction."""
TOOL_SPEED = 1.5
"""Of the box on its way, as a rule; tuned on the split dev [m/s]."""
DROP_TIME = 0.02
"""Time in which a box that is above its goal is down; tuned on the split dev [s]."""
SETTLED = -4.5
"""A tool counts as there so many control steps before its joints have stopped: it is within 15 mm by then."""


def billiard(scene: TrapperScene, **settings: Any) -> Billiard:
    """Forecasts the ball of ``scene``; ``settings`` are those of `Billiard`."""
    from torchdyn_plan.envs.trapper.scene import GRAVITY

    half_gap = 0.5 * (scene.pocket_gap - scene.ball_radius)
    gaps = [(middle - half_gap, middle + half_gap) for middle in (-scene.pocket_offset, scene.pocket_offset)]
    # A solid ball keeps 5/7 of what the cloth takes from its middle.
    rolling = 5.0 / 7.0 * GRAVITY * scene.rolling_resistance / scene.ball_radius
    own: dict[str, Any] = {
        "restitution": RESTITUTION,
        "restitution_deviation": RESTITUTION_DEVIATION,
        "deceleration": rolling,
        "sliding": SLIDING,
        "gaps": gaps,
        "gone_height": -2.0 * scene.ball_radius,
        "control_step": scene.control_step,
    }
    return Billiard(scene.half_side - scene.ball_radius + GIVE, **(own | settings))


def arm_arrival(scene: TrapperScene, joints: IKPlanner, **settings: Any) -> AnalyticArrival:
    """Arrival of the arm of ``scene`` at the ends of the paths of ``joints``; ``settings`` as of `AnalyticArrival`."""
    from torchdyn_plan.kinematics import UR5_LINKS

    count = len(UR5_LINKS)
    own: dict[str, Any] = {
        "speed": [scene.servo_speed * scene.joint_speed] * count,
        "acceleration": [scene.acceleration_limit] * count,
        "control_step": scene.control_step,
        "extra_steps": SETTLED,
    }
    return AnalyticArrival(joints, **(own | settings))


def pace_and_path(scene: TrapperScene, static: Any, **settings: Any) -> PaceAndPath:
    """`PaceAndPath` on ``static`` in ``scene``; ``settings`` are those of `PaceAndPath`."""
    from torchdyn_plan.planners import PaceAndPath

    own: dict[str, Any] = {
        "speed": TOOL_SPEED,
        "control_step": scene.control_step,
        "settle": DROP_TIME,
        "scene": scene.digest(),
    }
    return PaceAndPath(static, **(own | settings))
