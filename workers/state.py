"""A worker's claims and leases as a pure state machine: events in, actions out; no sockets, no clock."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from t4nmtd_dist.core.invariants import require
from t4nmtd_dist.wire.messages import Claim, Goodbye, Granted, Message, Refused, Role

FIRST_RETRY_S = 0.25
LONGEST_RETRY_S = 4.0
STANDBY_RETRY_S = 1.0
NEXT_SHARE_S = 5.0
FIRST_REMINDER_S = 1.0
REMINDER_S = 5.0
LIKE_A_NUMBER = re.compile(r"p[0-9]+")


@dataclass(frozen=True)
class SendClaim:
    """Send a claim."""

    claim: Claim


@dataclass(frozen=True)
class StartWork:
    """Start work under a lease, or continue under a new one."""

    granted: Granted


@dataclass(frozen=True)
class StopWork:
    """Stop work on a sub-task: its lease is over."""

    pid: str
    reason: str


@dataclass(frozen=True)
class SendRelease:
    """Release an unwanted lease, granted to a repeated claim."""

    granted: Granted


@dataclass(frozen=True)
class Print:
    """Show a line on the terminal."""

    text: str


@dataclass(frozen=True)
class Exit:
    """End the process."""

    code: int
    text: str


Action = SendClaim | StartWork | StopWork | SendRelease | Print | Exit


@dataclass
class _Place:
    """A lease that this worker wants.

    Attributes:
        wanted: a given pid or its number (p1), or None for any free one.
        held: the pid held now.
        kept: the pid held before a coordinator restart, to be claimed again.
    """

    wanted: str | None
    held: str | None = None
    kept: str | None = None
    next_try: float = 0.0
    retry: float = FIRST_RETRY_S


@dataclass
class WorkerState:
    """A worker's claims and leases.

    Args:
        pids: sub-tasks to claim; empty for the next free ones.
        coordinator: its endpoint, for messages to users.
        critic_endpoint: endpoint of this process's critics.
        wait_s: seconds of coordinator silence before giving up.
        now: the clock at the start.
    """

    role: Role
    instance: str
    pids: Sequence[str]
    coordinator: str
    critic_endpoint: str
    wait_s: float
    now: float
    _places: list[_Place] = field(init=False)

    def __post_init__(self) -> None:
        wanted: list[str | None] = list(self.pids) or [None]
        self._places = [_Place(pid, next_try=self.now) for pid in wanted]
        self._last_message = self.now
        self._remind_at = self.now + FIRST_REMINDER_S
        self._share_due: float | None = None
        self._standing_by = False

    @property
    def held(self) -> list[str]:
        """The places held now."""
        return [place.held for place in self._places if place.held is not None]

    def validate(self) -> None:
        """Check all invariants; tests call this after every event.

        Raises:
            InvariantError: if one is violated.
        """
        held = self.held
        require(len(set(held)) == len(held), "a place is held twice: {}", held)
        require(not (self._standing_by and held), "standing by while holding {}", held)
        require(self._share_due is None or self.role == "learner", "an evaluator waits for a share of the sub-tasks")
        require(self.role == "learner" or len(self._places) <= 1, "an evaluator wants several places")
        for place in self._places:
            _check_place(place, self.role)

    def tick(self, now: float) -> list[Action]:
        """Advance time: send due claims, or give up."""
        silent = now - self._last_message
        if silent > self.wait_s:
            text = (
                f"no coordinator answered at {self.coordinator} for {self.wait_s:.0f} s; "
                "start one with `t4nmtd-coordinator --task NAME`, or point --connect at it"
            )
            return [Exit(2, text)]
        actions: list[Action] = []
        if now >= self._remind_at:
            self._remind_at = now + REMINDER_S
            actions.append(
                Print(f"waiting for the coordinator at {self.coordinator} ({silent:.0f} of {self.wait_s:.0f} s)")
            )
        if self._share_due is not None and now >= self._share_due:
            self._places.append(_Place(None, next_try=now))
            self._share_due = None
        return actions + [self._ask(place, now) for place in self._places if self._due(place, now)]

    def _due(self, place: _Place, now: float) -> bool:
        return place.held is None and now >= place.next_try

    def _ask(self, place: _Place, now: float) -> SendClaim:
        place.next_try = now + place.retry
        place.retry = min(2 * place.retry, LONGEST_RETRY_S)
        pid = None if self.role == "evaluator" else place.wanted or place.kept
        return SendClaim(Claim(role=self.role, instance=self.instance, pid=pid, critic_endpoint=self.critic_endpoint))

    def forget(self, pid: str, now: float) -> None:
        """Drop a sub-task whose work ended here, and claim again."""
        for place in self._places:
            if pid in (place.held, place.kept):
                place.held, place.kept, place.next_try = None, None, now

    def discount_blocked_time(self, since: float, now: float) -> None:
        """Do not count time this process was blocked as coordinator silence."""
        self._last_message = min(now, self._last_message + now - since)
        self._remind_at += now - since

    def receive(self, now: float, message: Message) -> list[Action]:
        """Process a message from the coordinator."""
        self._last_message = now
        self._remind_at = now + REMINDER_S
        if isinstance(message, Granted):
            return self._granted(message, now)
        if isinstance(message, Refused):
            return self._refused(message, now)
        if isinstance(message, Goodbye):
            return [Exit(0, f"the run is over: {message.reason}")]
        return []

    def _granted(self, granted: Granted, now: float) -> list[Action]:
        place = self._place_for(granted)
        if place is None:
            return [SendRelease(granted)]
        self._places = [other for other in self._places if other is place or not _wants_the_same(other, granted)]
        ended = self._stop_kept(place, "the coordinator gave another sub-task") if place.kept != granted.pid else []
        place.held, place.kept = granted.pid, None
        place.retry = FIRST_RETRY_S
        self._standing_by = False
        if place.wanted is None and self.role == "learner":
            self._share_due = now + NEXT_SHARE_S
        number = f"{granted.asked} is {granted.pid}; " if granted.asked not in ("", granted.pid) else ""
        return [*ended, StartWork(granted), Print(f"{number}holds {granted.pid} (epoch {granted.epoch})")]

    def _place_for(self, granted: Granted) -> _Place | None:
        pid, asked = granted.pid, granted.asked or granted.pid
        matching = [place for place in self._places if pid in (place.held, place.kept) or asked == place.wanted]
        open_places = [place for place in self._places if place.held is None and place.wanted is None]
        open_places.sort(key=lambda place: place.kept is not None)
        return next(iter(matching + open_places), None)

    def _stop_kept(self, place: _Place, reason: str) -> list[Action]:
        """Stop the work that a place kept."""
        kept, place.kept = place.kept, None
        return [] if kept is None or kept in self.held else [StopWork(kept, f"{kept} is over here: {reason}")]

    def _refused(self, refused: Refused, now: float) -> list[Action]:
        if refused.reason == "stale epoch":
            return self._stale(refused, now)
        keeping = [place for place in self._places if place.kept is not None and place.kept == refused.pid]
        if keeping and keeping[0].wanted is None:
            keeping[0].next_try = now
            return self._stop_kept(keeping[0], refused.text)
        if refused.final:
            return [Exit(2, refused.text)]
        for place in self._places:
            if place.held is None and place.wanted is None:
                place.next_try = now + STANDBY_RETRY_S
        if self._standing_by or self.held:
            return []
        self._standing_by = True
        return [Print(refused.text)]

    def _stale(self, refused: Refused, now: float) -> list[Action]:
        for place in self._places:
            if refused.pid is None or refused.pid in (place.held, place.kept):
                lost = place.held or place.kept
                place.held, place.kept = None, None if self.role == "evaluator" else lost
                place.next_try = now
                if refused.final and lost is not None:
                    return self._give_up(place, lost, refused)
        return [Print(refused.text)]

    def _give_up(self, place: _Place, pid: str, refused: Refused) -> list[Action]:
        ended: list[Action] = [StopWork(pid, refused.text)]
        place.kept = None
        if place.wanted is None:
            return ended
        self._places.remove(place)
        return ended if self._places else [*ended, Exit(2, refused.text)]


def _wants_the_same(place: _Place, granted: Granted) -> bool:
    """Whether a place wants the sub-task just granted to another."""
    return place.wanted is not None and (place.held == granted.pid or place.wanted in (granted.pid, granted.asked))


def _check_place(place: _Place, role: Role) -> None:
    wanted, held, kept = place.wanted, place.held, place.kept
    require(held is None or kept is None, "{} is held in the place of {}", held, kept)
    require(FIRST_RETRY_S <= place.retry <= LONGEST_RETRY_S, "claims are {} s apart", place.retry)
    named = held is None or wanted in (None, held) or LIKE_A_NUMBER.fullmatch(str(wanted)) is not None
    require(named, "{} is held, {} was wanted", held, wanted)
    require(role == "learner" or (held in (None, role) and kept is None), f"an evaluator holds {held}, keeps {kept}")
