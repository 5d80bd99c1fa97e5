"""The command line program `planner-jax`: its commands, options and messages."""
