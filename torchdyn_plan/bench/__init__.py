"""Benchmarks of ``torchdyn-plan bench``: latency of plans, rate of environments, kinematics compared with others."""
