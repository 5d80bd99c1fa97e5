"""The car: chassis, tyres, control and its form in MuJoCo."""
