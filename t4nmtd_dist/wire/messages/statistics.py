"""Learner statistics, each declared once: type, how to sum it, and where to show it.

To add a statistic, add a field to ``LearnerStats``. Sums over leases, columns of ``metrics/<pid>.csv``, TensorBoard
curves and dashboard columns are derived from it (``wire.statistics``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from t4nmtd_dist.wire.fields import Amount, Count
from t4nmtd_dist.wire.messages.base import Message

LearnerPhase = Literal["free", "waiting", "training", "lost"]
Format = Literal["", "count", "rate", "percent", "bar", "mean"]
PER_SECOND = "second"


@dataclass(frozen=True)
class View:
    """One view of a statistic: its value, its rate per second, or a ratio.

    Attributes:
        scalar: name of its TensorBoard curve; empty for none.
        heading: of its dashboard column.
        format: of the column; empty for no column.
        needs: page width in terminal cells from which the column is shown.
        short: heading on narrow pages, if different.
        per: ``PER_SECOND`` for the rate over the last ten seconds, else the name of the ratio's denominator.
    """

    scalar: str = ""
    heading: str = ""
    format: Format = ""
    needs: int = 0
    short: str = ""
    per: str = ""


@dataclass(frozen=True)
class Statistic:
    """A statistic's declaration, apart from its type.

    Attributes:
        counter: whether it counts up from 0 under each lease, so that leases are summed; else the newest value is used.
        views: where it is shown besides the CSV file.
    """

    counter: bool
    views: tuple[View, ...] = ()


def counter(*views: View) -> Statistic:
    """A statistic that counts up from 0 under each lease."""
    return Statistic(True, views)


def gauge(*views: View) -> Statistic:
    """A statistic whose newest value is used."""
    return Statistic(False, views)


ANSWERED = View(heading="answers", format="percent", per="asked")
OWN_USED = View("own_used_share", "own", "percent", needs=76, per="asked")
LAG = View("mean_lag", "lag", "mean", needs=60, per="answered")


class Intervention(Message, frozen=True):
    """Counts of critic values requested from peers, in rows, since the lease began (see ``InterventionCounts``)."""

    asked: Annotated[Count, counter()] = 0
    answered: Annotated[Count, counter(ANSWERED)] = 0
    late: Annotated[Count, counter()] = 0
    own_used: Annotated[Count, counter(OWN_USED)] = 0
    lag_total: Annotated[Count, counter(LAG)] = 0


STEPS = View(heading="interactions", format="count", short="steps")
STEPS_PER_S = View("steps_per_s", "steps/s", "rate", per=PER_SECOND)
UPDATES = View(heading="updates", format="count", needs=140)
UPDATES_PER_S = View("updates_per_s", "upd/s", "rate", per=PER_SECOND)
ATTEMPTS = View(heading="attempts", format="count", needs=126)
SUCCESS_BAR = View(format="bar", needs=96)
SUCCESS = View("recent_success", "success", "percent")


class LearnerStats(Message, frozen=True):
    """Statistics of one learner since its lease began; the coordinator adds earlier epochs.

    ``entropy`` is in nats. ``peer_rows``: peers' experiences available for learning now. ``processor_s``: CPU time of
    acting and learning, in seconds. ``errors``, ``timeouts`` and ``terminated``: failed attempts that ended in an error
    state, at the time limit, and with the environment.
    """

    phase: LearnerPhase = "waiting"
    interactions: Annotated[Count, counter(STEPS, STEPS_PER_S)] = 0
    gradient_steps: Annotated[Count, counter(UPDATES, UPDATES_PER_S)] = 0
    attempts: Annotated[Count, counter(ATTEMPTS)] = 0
    successes: Annotated[Count, counter()] = 0
    recent_success: Annotated[float | None, gauge(SUCCESS_BAR, SUCCESS)] = None
    episode_steps: Annotated[float | None, gauge()] = None
    entropy: Annotated[float | None, gauge(View("entropy"))] = None
    value_loss: Annotated[float | None, gauge(View("critic_loss"))] = None
    peer_rows: Annotated[Count, gauge()] = 0
    processor_s: Annotated[Amount, counter()] = 0.0
    intervention: Intervention = Intervention()
    errors: Annotated[Count, counter()] = 0
    timeouts: Annotated[Count, counter()] = 0
    terminated: Annotated[Count, counter()] = 0
