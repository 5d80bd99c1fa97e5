"""Run folders: manifest, rows, tables and figures of a command."""
