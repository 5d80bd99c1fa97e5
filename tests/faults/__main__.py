"""Inject every fault many times, and print how often a run survived it.

    python -m tests.faults [--share F] [--only NAME,...] [--jobs N] [--out FILE]

F scales the number of trials; N trials run at once. A killed run survives if it is resumed to the
results of an undisturbed run. Of two processes that write one folder, one must end with an error
line. A damaged file must be rejected, be planned again, or have no effect.
"""

import argparse
import multiprocessing
import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from tests.faults.trials import TRIALS, make_whole, try_some


def main() -> int:
    parser = argparse.ArgumentParser("python -m tests.faults", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--share", type=float, default=1.0, help="of all trials (default: 1)")
    parser.add_argument("--only", help="names, comma-separated, that a trial's begins with")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once (default: 1)")
    parser.add_argument("--out", type=Path, help="file for the table")
    options = parser.parse_args()
    only = tuple(options.only.split(",")) if options.only else ("",)
    chosen = [k for k, trial in enumerate(TRIALS) if trial.name.startswith(only)]
    lines = ["| fault | tried | survived | how |", "|---|---:|---:|---|"]
    print("\n".join(lines), flush=True)
    lost = 0
    spawn = multiprocessing.get_context("spawn")
    with (
        tempfile.TemporaryDirectory(prefix="faults-") as folder,
        ProcessPoolExecutor(options.jobs, spawn) as pool,
    ):
        base = Path(folder)
        list(pool.map(partial(make_whole, base=base), {TRIALS[k].whole for k in chosen}))
        parts = {}
        for k in chosen:
            num, most = max(1, round(options.share * TRIALS[k].num)), TRIALS[k].most
            sizes = [min(most, num - first) for first in range(0, num, most)]
            parts[k] = [pool.submit(try_some, k, j, size, base) for j, size in enumerate(sizes)]
        for k in chosen:
            found = [outcome for part in parts[k] for outcome in part.result()]
            survived = sum(good for good, _ in found)
            how = Counter(word for good, word in found if good)
            ways = ", ".join(f"{word} {count}" for word, count in how.most_common())
            lines.append(f"| {TRIALS[k].words} | {len(found):,} | {survived:,} | {ways} |")
            print(lines[-1], flush=True)
            for word in (word for good, word in found if not good):
                lost += 1
                print(f"not survived: {TRIALS[k].name}: {word}", file=sys.stderr, flush=True)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text("\n".join(lines) + "\n")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
