"""The simulated arm with a shield: its drives, its controller and its model in MuJoCo."""
