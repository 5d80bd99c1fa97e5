"""Direct transcription of a hit, to tell infeasible cases from missed ones."""
