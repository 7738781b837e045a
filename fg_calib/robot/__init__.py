"""The arm: its parameters and conventions, its chain, forward and inverse kinematics."""
