"""The arm: drives of its joints, control and its form in MuJoCo."""
