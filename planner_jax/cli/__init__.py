"""The command `planner-jax`."""
