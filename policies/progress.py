"""Progress of a training: rows of `progress.jsonl`, a progress bar, and TensorBoard event files.

In a decision, the policy chooses order and times of the catches in one random case, a planning
problem. Each line of `progress.jsonl` is a row in JSON. A row has the number of the `part` (call of
PPO) of the training, and the number of `decisions` since its start. There are two kinds of rows:

* Rows of the learning curve hold means over the decisions since the previous row: `reward`; the
  fraction `solved`; for solved cases `last`, the fraction by which the last catch is earlier than
  with the greedy order, and `ratio`, the relative difference of decided and planned times; for
  unsolved cases `violation`, the greatest relative excess over a limit. They also hold the number
  of decisions `per_second`, the KL `divergence` of a PPO update, the `learning_rate`, and `spread`,
  the standard deviation of the actions.
* Rows with `suites` hold an evaluation of the policy with the full number of planner iterations.

The first line of the file instead holds the format, the number of rows and their digest.
`training.json` holds the settings of the training, the format and the version of the code.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from brax.training.agents.ppo import losses
from tensorboardX import SummaryWriter
from tqdm import tqdm

from planner_jax.core.errors import ArgumentError
from planner_jax.host import signals as stopping
from planner_jax.host.files import read_plain
from planner_jax.runs.manifest import (
    LARGEST,
    JsonError,
    parse_object,
    parse_written,
    read_written,
    to_write,
)
from planner_jax.runs.run_folder import RunFolder

FILE, SETTINGS = "progress.jsonl", "training.json"
_EVENTS = "tensorboard"


@contextlib.contextmanager
def report_terms() -> Iterator[None]:
    """Make Brax's PPO report the mean reward and its unweighted terms, within the `with` block.

    The loss function of Brax is replaced by a function that adds these means to the metrics. Brax
    itself reports them only for 100 environments, by callbacks from the compiled program to Python.
    JAX does not store programs with such callbacks in its compilation cache.
    """
    plain = losses.compute_ppo_loss

    def reporting(params: Any, normaliser: Any, data: Any, *others: Any, **how: Any) -> Any:
        loss, metrics = plain(params, normaliser, data, *others, **how)
        terms = data.extras["state_extras"]["episode_metrics"]
        good = terms["solved"]
        means = {
            "reward": jnp.mean(data.reward),
            "solved": jnp.mean(good),
            "last": jnp.mean(good * terms["last"]),
            "ratio": jnp.mean(good * terms["ratio"]),
            "violation": jnp.mean((1.0 - good) * terms["violation"]),
        }
        return loss, {**metrics, **means}

    losses.compute_ppo_loss = reporting
    try:
        yield
    finally:
        losses.compute_ppo_loss = plain


def _row_of(metrics: Mapping[str, Any]) -> dict[str, float | None]:
    found = {name.removeprefix("training/"): float(value) for name, value in metrics.items()}
    solved, others = found["solved"], 1.0 - found["solved"]
    return {
        "per_second": round(found["sps"], 1),
        "reward": found["reward"],
        "solved": solved,
        "last": found["last"] / solved if solved > 0.0 else None,
        "ratio": found["ratio"] / solved if solved > 0.0 else None,
        "violation": found["violation"] / others if others > 0.0 else None,
        "divergence": found["kl_mean"],
        "learning_rate": found["learning_rate"],
        "spread": found["policy_dist_mean_std"],
    }


class Progress:
    """The rows of a training run, kept in memory and in the file `progress.jsonl`.

    Each new row rewrites the whole file atomically. When a run is resumed, the rows of the file are
    read first.

    Args:
        folder: folder of the run.
        show: whether to show a progress bar on standard error.
    """

    def __init__(self, folder: Path, show: bool):
        self.rows = read_rows(folder) if (folder / FILE).exists() else []
        self._folder, self._show = folder, show

    @contextlib.contextmanager
    def part(
        self, number: int, title: str, before: int, decisions: int
    ) -> Iterator[Callable[[int, Mapping[str, Any]], None]]:
        """Provide the callback by which Brax reports progress in one part (PPO run) of a training.

        Brax calls it with the number of cases that the policy has decided in this part, and with
        its own metrics by name, such as the mean reward. Rows of this part and of later parts,
        which an interrupted run may have left, are removed first.

        Args:
            number: number of the part.
            title: title of the progress bar.
            before: number of cases that the policy has decided in all earlier parts.
            decisions: number of cases that it decides in this part.
        """
        self.rows = [row for row in self.rows if row["part"] < number]
        place, suffix = self._folder / _EVENTS, f".part-{number:03d}"
        for left in place.glob(f"*{suffix}"):
            left.unlink()
        how: dict[str, Any] = {"unit": " decisions", "unit_scale": True}
        with (
            SummaryWriter(os.fspath(place), filename_suffix=suffix) as events,
            tqdm(total=decisions, desc=title, disable=not self._show, **how) as bar,
        ):

            def tell(done: int, metrics: Mapping[str, Any]) -> None:
                stopping.check()
                row = _row_of(metrics)
                self.add(number, before + done, row)
                for name, value in row.items():
                    if value is not None:
                        events.add_scalar(f"training/{name}", value, before + done)
                events.flush()
                shown = f"reward {row['reward']:.3f}, solved {100.0 * (row['solved'] or 0.0):.1f} %"
                bar.set_postfix_str(shown, refresh=False)
                bar.update(done - bar.n)

            yield tell

    def add_evaluation(self, number: int, decisions: int, suites: Mapping[str, Any]) -> None:
        """Add a row with the results, by suite, of an evaluation after part (PPO run) `number`."""
        self.add(number, decisions, {"suites": suites})

    def add(self, number: int, decisions: int, row: Mapping[str, Any]) -> None:
        """Add the entries `row` to the rows of part (PPO run) `number`; rewrite `progress.jsonl`.

        `decisions` is the number of cases that the policy has decided since the training's start.
        """
        self.rows.append({"part": number, "decisions": decisions, **row})
        RunFolder(self._folder).write_text(FILE, to_text(self.rows))


def to_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the text of `progress.jsonl`: a line with the rows' SHA-256, then a line per row."""
    text = "".join(json.dumps(row) + "\n" for row in rows)
    head = {"rows": len(rows), "sha256": hashlib.sha256(text.encode()).hexdigest()}
    return json.dumps(to_write(head)) + "\n" + text


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Read the rows of a training run from `progress.jsonl`, in the order of their creation.

    Raises:
        ArgumentError: the folder does not hold a training, or the file does not match its digest.
    """
    shown = repr(str(folder))
    try:
        text = read_plain(folder / FILE, LARGEST)
    except OSError as error:
        rule = f"the folder of a training, with its {FILE}"
        raise ArgumentError("run", rule, shown=f"{shown} ({error.strerror})") from None
    first, _, rest = text.partition(b"\n")
    try:
        head = parse_written(first)
        if head.get("sha256") != hashlib.sha256(rest).hexdigest():
            raise JsonError("does not match its digest")
        rows = [parse_object(line) for line in rest.splitlines()]
    except JsonError as error:
        rule = f"a training whose {FILE} is whole"
        raise ArgumentError("run", rule, shown=f"{shown}, where it {error}") from None
    return rows


def read_settings(folder: Path) -> dict[str, Any]:
    """Read the settings of a training run from `training.json` in its folder.

    Raises:
        ArgumentError: the folder does not hold a training, or the file is damaged.
    """
    return read_written(folder / SETTINGS, "run", "a training")
