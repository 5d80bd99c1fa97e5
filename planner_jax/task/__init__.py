"""One room a task, and the one call that plans them all."""
