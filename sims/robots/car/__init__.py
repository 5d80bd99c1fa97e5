"""The simulated car: its chassis, tyres, controller and model in MuJoCo."""
