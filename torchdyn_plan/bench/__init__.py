"""What ``torchdyn-plan bench`` runs: the latency of plans, the rate of environments, and kinematics beside others'."""
