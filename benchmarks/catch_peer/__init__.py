"""The problem of `PaperCatch` with one ball in C++, with solvers of its own."""
