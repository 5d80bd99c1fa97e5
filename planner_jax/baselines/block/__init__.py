"""Published methods for blocks: a robot arm stops a thrown ball with a shield."""
