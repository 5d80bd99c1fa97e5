"""The searches of the default planner of blocks: straight motions, then least squares."""
