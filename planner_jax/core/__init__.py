"""The contract of planners, cases and tasks: statuses, rules, checks, registry, plan files."""
