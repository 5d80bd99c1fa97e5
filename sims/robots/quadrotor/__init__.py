"""The simulated quadrotor: its model in MuJoCo, its references and its controller."""
