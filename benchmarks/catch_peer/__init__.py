"""The problem of `PaperCatch` with one ball once more in C++, with a search of its own."""
