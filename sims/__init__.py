"""Flight of the plans in simulation: quadrotors that catch and hit in closed loop."""
