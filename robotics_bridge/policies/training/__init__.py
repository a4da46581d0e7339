"""Training of policies: privileged teachers by PPO, students by distillation, and sweeps of both."""
