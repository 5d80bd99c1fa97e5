"""The functions plan, solve, replan and gradient, for planners of any kind."""
