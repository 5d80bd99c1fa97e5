"""What the tests of every task's sweep share, besides the fixture `finished`."""

import numpy as np
import pyarrow.parquet as pq


def columns(out):
    """The rows of a run as NumPy arrays, lists stacked."""
    table = pq.read_table(out / "plans.parquet")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def stop_after(monkeypatch, sweep, num_chunks):
    """Ctrl-C in the chunk after so many: in the call of `plan` of that class of sweeps."""
    calls = iter(range(num_chunks))

    def plan(*arguments):
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return real(*arguments)

    real = sweep.plan
    monkeypatch.setattr(sweep, "plan", plan)
