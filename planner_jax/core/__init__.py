"""Base classes of planners, plans and cases, checks of arguments, and the registry of names."""
