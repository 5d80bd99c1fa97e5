"""Folders of runs, in which sweeps and flights store their manifest, rows, table and figures."""
