"""Direct transcription of a hit, to distinguish infeasible cases from failures of a planner."""
