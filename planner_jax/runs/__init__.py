"""Run folders: manifest, tables, environment and figures of what a command computed."""
