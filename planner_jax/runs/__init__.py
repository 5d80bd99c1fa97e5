"""Folders in which many planned and judged problems are stored: manifest, rows and figures."""
