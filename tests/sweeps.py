"""What the tests of every task's sweep share, besides the fixture `finished`."""

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq


def columns(out):
    """The rows of a run as NumPy arrays, lists stacked."""
    table = pq.read_table(out / "plans")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def rows_of(out):
    """The rows of a run bit for bit, without how long they took to make."""
    table = pq.read_table(out / "plans").replace_schema_metadata(None)
    file = io.BytesIO()
    with pa.ipc.new_file(file, table.schema) as writer:
        writer.write_table(table)
    return file.getvalue()


def stop_after(monkeypatch, sweep, num_chunks):
    """Ctrl-C in the chunk after so many: in the call of `plan` of that class of sweeps."""
    calls = iter(range(num_chunks))

    def plan(*arguments):
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return real(*arguments)

    real = sweep.plan
    monkeypatch.setattr(sweep, "plan", plan)
