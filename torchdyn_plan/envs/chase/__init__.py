"""The world of chase: bases on wheels that meet people who walk past."""

from torchdyn_plan.envs.chase.env import ChaseEnv, ChaseWorld

__all__ = ["ChaseEnv", "ChaseWorld"]
