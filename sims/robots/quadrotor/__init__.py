"""The simulated quadrotor: its parts, its body in MuJoCo, what it tracks, and how."""
