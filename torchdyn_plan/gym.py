"""Gymnasium's names of this package's worlds: importing this module registers them.

    import gymnasium, torchdyn_plan.gym
    env = gymnasium.make("torchdyn_plan/TrapperStatic-v0")
    envs = gymnasium.make_vec("torchdyn_plan/TrapperStatic-v0", num_envs=64)  # one batched simulation

Where only a name can be given, ``torchdyn_plan.gym:torchdyn_plan/TrapperStatic-v0`` imports the module, too.
"""

import gymnasium

NAMESPACE = "torchdyn_plan"

FORMS = {
    "TrapperStatic-v0": ("GoalGymEnv", "torchdyn_plan.envs.trapper.gym_forms:STATIC"),
    "TrapperStaticFlat-v0": ("GymEnv", "torchdyn_plan.envs.trapper.gym_forms:STATIC_FLAT"),
    "TrapperDynamic-v0": ("GymEnv", "torchdyn_plan.envs.trapper.gym_forms:DYNAMIC"),
    "Reach-v0": ("GoalGymEnv", "torchdyn_plan.envs.fetch_reach.gym_forms:MOVING"),
    "ReachStatic-v0": ("GoalGymEnv", "torchdyn_plan.envs.fetch_reach.gym_forms:STATIC"),
}
"""The class of `torchdyn_plan.envs.gym_env` and the form behind each name."""

for _name, (_kind, _form) in FORMS.items():
    if f"{NAMESPACE}/{_name}" not in gymnasium.registry:
        gymnasium.register(
            f"{NAMESPACE}/{_name}",
            entry_point=f"torchdyn_plan.envs.gym_env:{_kind}",
            vector_entry_point="torchdyn_plan.envs.gym_env:GymVectorEnv",
            kwargs={"form": _form},
        )
