"""The key of this task alone, beside those of `torchdyn_plan.keys`."""

from torchdyn_plan.keys import Key

REACHED = "reached"

KEYS: tuple[Key, ...] = (
    Key(name=REACHED, shape=(1,), meaning="the gripper has been at its goal in this episode", writer="env"),
)
"""Every key of this task."""
