"""Every environment of the package, by name, as small as it can be."""

from tests.envs.points import PointEnv
from torchdyn_plan.envs import DynamicReachEnv, TrapperEnv, TrapperGoalEnv


def _make(kind, **fixed):
    def make(num_envs=2, **settings):
        return kind(num_envs, **{"num_threads": 1, "seed": 0, **fixed, **settings})

    return make


WORLDS = {
    "points": lambda num_envs=2, **settings: PointEnv(num_envs, **{"seed": 0, **settings}),
    "trapper": _make(TrapperEnv),
    "trapper, static": _make(TrapperEnv, static_target=True),
    "goals": _make(TrapperGoalEnv, max_steps=100),
    "reach": _make(DynamicReachEnv),
    "reach, static": _make(DynamicReachEnv, static_target=True),
}
"""What makes each: ``(num_envs=2, **settings)``, series 0 unless told otherwise."""
