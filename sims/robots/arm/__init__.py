"""The arm: its drives, its controller and its model in MuJoCo."""
