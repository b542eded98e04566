"""The keys of this task alone, beside those of `torchdyn_plan.keys`."""

from torchdyn_plan.keys import Key

TRAPPED = "trapped"
POCKETED = "pocketed"
REACHED = "reached"
TOOL_ROTATION = "tool_rotation"

KEYS: tuple[Key, ...] = (
    Key(name=TRAPPED, shape=(1,), meaning="the ball is covered by the box, and was for a while", writer="env"),
    Key(name=POCKETED, shape=(1,), meaning="the ball fell into a pocket", writer="env"),
    Key(name=REACHED, shape=(1,), meaning="the box is at its goal, as the reward has it", writer="goal env"),
    Key(name=TOOL_ROTATION, shape=(3, 3), meaning="the box's axes in the world, as columns", writer="goal env"),
)
"""Every key of this task."""
