"""The tensordict keys that environments, planners and training share, in one table.

Keys of one task alone stand beside its environment.
"""

from dataclasses import dataclass

JOINT_POS = "joint_pos"
JOINT_VEL = "joint_vel"
TOOL_POS = "tool_pos"
TARGET_POS = "target_pos"
TARGET_HISTORY = "target_history"
HISTORY_LENGTH = "history_length"
TARGET_QUAT = "target_quat"
TARGET_FUTURE = "target_future"
TRUE_FUTURE = "true_future"
MEASURED_POS = "measured_pos"
MEASURED_TIME = "measured_time"
TRUE_TARGET_POS = "true_target_pos"
TARGET_COVARIANCE = "target_covariance"
ROBOT_STATE = "robot_state"
OBSERVATION = "observation"
ACHIEVED_GOAL = "achieved_goal"
DESIRED_GOAL = "desired_goal"
STEP_COUNT = "step_count"
GOAL = "goal"
GOAL_POSE = "goal_pose"
ARRIVAL_STEPS = "arrival_steps"
ACTION = "action"
EPISODE = "episode"
PLAN = "plan"
TARGETS_PRESENT = "targets_present"
TARGETS_VALUE = "targets_value"
TARGETS_POS = "targets_pos"
TARGETS_HISTORY = "targets_history"
TARGETS_QUAT = "targets_quat"
OF_ALL_TARGETS = {TARGET_POS: TARGETS_POS, TARGET_HISTORY: TARGETS_HISTORY, TARGET_QUAT: TARGETS_QUAT}
"""The entry that holds of each of several targets what an entry holds of the one that is to be met."""
TRUTHS = frozenset((TARGET_FUTURE, TRUE_FUTURE))
"""What no planner can know outside of an evaluation."""


@dataclass(frozen=True, kw_only=True)
class Key:
    """What one tensordict entry holds: its trailing shape in symbols, its unit and frame, and its writer."""

    name: str
    shape: tuple[str | int, ...]
    """Trailing shape after the batch: D coordinates of a point (2 in a plane, 3 in space), N joints, A action size,
    H history, F horizon, S robot state size, M measurements that can come at a step, K targets of which one is met."""
    meaning: str
    writer: str


KEYS: tuple[Key, ...] = (
    Key(name=JOINT_POS, shape=("N",), meaning="joint angles [rad]", writer="env"),
    Key(name=JOINT_VEL, shape=("N",), meaning="joint speeds [rad/s]", writer="env"),
    Key(name=TOOL_POS, shape=("D",), meaning="place of the tool [m, world]", writer="env"),
    Key(name=TARGET_POS, shape=("D",), meaning="centre of the target [m, world]", writer="env"),
    Key(name=TARGET_HISTORY, shape=("H", "D"), meaning="target positions, oldest first [m, world]", writer="env"),
    Key(name=HISTORY_LENGTH, shape=(), meaning="samples in the history that are no padding", writer="env"),
    Key(name=ROBOT_STATE, shape=("S",), meaning="what a policy or an ETA network reads", writer="env"),
    Key(name=OBSERVATION, shape=("S",), meaning="robot state under TorchRL's name", writer="env"),
    Key(name=ACHIEVED_GOAL, shape=("D",), meaning="tool position under Gymnasium's name [m, world]", writer="env"),
    Key(name=DESIRED_GOAL, shape=("D",), meaning="place to reach [m, world]", writer="env"),
    Key(name=STEP_COUNT, shape=(1,), meaning="control steps since the reset", writer="env"),
    Key(name=EPISODE, shape=(), meaning="index of the episode within its split and seed", writer="env"),
    Key(name=GOAL, shape=("D",), meaning="place the static planner is sent to [m, world]", writer="planner"),
    Key(
        name=GOAL_POSE,
        shape=(7,),
        meaning="goal, and how the tool is turned there: quaternion wxyz, zeros for as it is [m, world]",
        writer="planner",
    ),
    Key(name=ARRIVAL_STEPS, shape=(), meaning="control steps from now to the meeting", writer="planner"),
    Key(name=ACTION, shape=("A",), meaning="what the robot is told to do, each entry -1 to 1", writer="static planner"),
    Key(
        name=MEASURED_POS,
        shape=("M", "D"),
        meaning="measurements that come now [m, world]",
        writer="sensor",
    ),
    Key(name=MEASURED_TIME, shape=("M",), meaning="when they were taken [s since the reset]", writer="sensor"),
    Key(
        name=TRUE_TARGET_POS, shape=("D",), meaning="the target itself, for those who judge [m, world]", writer="sensor"
    ),
    Key(name=TARGET_COVARIANCE, shape=(2, 2), meaning="of position and velocity [m², m²/s, m²/s²]", writer="track"),
    Key(name=TARGET_QUAT, shape=(4,), meaning="how the target is turned: quaternion wxyz, world", writer="task"),
    Key(name=TARGETS_PRESENT, shape=("K",), meaning="whether there is a target in each slot", writer="task"),
    Key(name=TARGETS_VALUE, shape=("K",), meaning="what each target is worth", writer="task"),
    Key(name=TARGETS_POS, shape=("K", "D"), meaning="centres of the targets [m, world]", writer="task"),
    Key(name=TARGETS_HISTORY, shape=("K", "H", "D"), meaning="their positions, oldest first [m, world]", writer="task"),
    Key(name=TARGETS_QUAT, shape=("K", 4), meaning="how they are turned: quaternions wxyz, world", writer="task"),
    Key(name=TARGET_FUTURE, shape=("F", "D"), meaning="recorded truth, from step 0 on [m, world]", writer="evaluation"),
    Key(name=TRUE_FUTURE, shape=("F", "D"), meaning="the truth from the next step on [m, world]", writer="evaluation"),
    Key(name=PLAN, shape=(), meaning="the planner's memory between steps (nested)", writer="planner"),
)
"""Every shared key. Further entries below ``plan`` belong to the planner that wrote them."""
