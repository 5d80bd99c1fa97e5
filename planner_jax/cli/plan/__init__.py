"""The command `planner-jax plan`: it plans and referees one case that a few options specify."""
