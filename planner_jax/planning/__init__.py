"""The calls of a user: plan, solve, replan and gradient, for planners of any kind."""
