"""The simulated quadrotor: its parts, model in MuJoCo, references and controller."""
