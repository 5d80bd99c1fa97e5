"""How a training is watched: rows of the run folder, a bar, and event files of TensorBoard.

Every row of `progress.jsonl` has `part` and `decisions`, of all parts until then. Rows of the curve
have the means of the decisions since the last one: `reward`, `solved`, of solved cases `last` and
`ratio`, of others `violation`, as `environment.judged` has them, beside `per_second` decisions and
what PPO did: `divergence` of an update, `learning_rate`, and `spread`, the standard deviation of
actions. Rows with `suites` say what the policy's decisions were worth then, planned in full. The
first line has the format, how many rows follow, and their digest. `training.json` says what is
trained, in which format, and by which code.
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
from planner_jax.host.files import open_plain
from planner_jax.runs.manifest import (
    JsonError,
    parse_object,
    parse_written,
    read_written,
    to_write,
)
from planner_jax.runs.run_folder import RunFolder

FILE, ASKED = "progress.jsonl", "training.json"
_EVENTS = "tensorboard"


@contextlib.contextmanager
def reported_terms() -> Iterator[None]:
    """Have Brax's PPO report reward and raw terms, as means of all decisions, with its metrics.

    Brax itself reports them by calls from the compiled program to the host. It does so of 100
    lanes only, and JAX keeps no program with such calls in its cache.
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
    """A row of the curve from Brax's metrics with `reported_terms`."""
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
    """The rows of a run.

    The file is replaced as a whole with every row, and read again where a run goes on.

    Args:
        folder: of the run.
        show: a bar on the standard error stream.
    """

    def __init__(self, folder: Path, show: bool):
        self.rows = read_rows(folder) if (folder / FILE).exists() else []
        self._folder, self._show = folder, show

    @contextlib.contextmanager
    def part(
        self, number: int, title: str, begun: int, decisions: int
    ) -> Iterator[Callable[[int, Mapping[str, Any]], None]]:
        """What Brax is to call with decisions of a part and its metrics, while the part trains.

        What an interrupted run left of the part, or of later ones, is forgotten.

        Args:
            number: of the part.
            title: of the bar.
            begun: decisions before the part.
            decisions: of the part.
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
                self.add(number, begun + done, row)
                for name, value in row.items():
                    if value is not None:
                        events.add_scalar(f"training/{name}", value, begun + done)
                events.flush()
                shown = f"reward {row['reward']:.3f}, solved {100.0 * (row['solved'] or 0.0):.1f} %"
                bar.set_postfix_str(shown, refresh=False)
                bar.update(done - bar.n)

            yield tell

    def judge(self, number: int, decisions: int, suites: Mapping[str, Any]) -> None:
        """Add what a policy's decisions are worth, by suite, as in `training.judge_policy`."""
        self.add(number, decisions, {"suites": suites})

    def add(self, number: int, decisions: int, row: Mapping[str, Any]) -> None:
        """Add a row to the file."""
        self.rows.append({"part": number, "decisions": decisions, **row})
        RunFolder(self._folder).write_text(FILE, to_text(self.rows))


def to_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """The contents of `progress.jsonl`."""
    text = "".join(json.dumps(row) + "\n" for row in rows)
    head = {"rows": len(rows), "sha256": hashlib.sha256(text.encode()).hexdigest()}
    return json.dumps(to_write(head)) + "\n" + text


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of a run, in the order of their decisions.

    Raises:
        ArgumentError: the folder is not that of a training, or a row is not as it was written.
    """
    shown = repr(str(folder))
    try:
        with open_plain(folder / FILE) as file:
            text = file.read()
    except OSError as error:
        rule = f"the folder of a training, with its {FILE}"
        raise ArgumentError("run", rule, shown=f"{shown} ({error.strerror})") from None
    first, _, rest = text.partition(b"\n")
    try:
        head = parse_written(first)
        if head.get("sha256") != hashlib.sha256(rest).hexdigest():
            raise JsonError("has other rows than were written")
        rows = [parse_object(line) for line in rest.splitlines()]
    except JsonError as error:
        rule = f"a training whose {FILE} is whole"
        raise ArgumentError("run", rule, shown=f"{shown}, where it {error}") from None
    return rows


def read_asked(folder: Path) -> dict[str, Any]:
    """What a training was asked for, of `training.json`.

    Raises:
        ArgumentError: the folder is not that of a training, or it is not as it was written.
    """
    return read_written(folder / ASKED, "run", "a training")
