"""What is raised where a plan cannot be brought to rest."""


class NoEnding(ValueError):
    """No way to rest behind a plan keeps every limit; one line that says which one fails."""
