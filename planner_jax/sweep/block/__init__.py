"""The sweep of blocks: a robot arm blocks thrown balls with a shield."""
