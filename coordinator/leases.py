"""Leases on sub-tasks. Each takeover raises the epoch; messages from older epochs are rejected."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Lease:
    """A worker's right to a place until its release or ``expires`` (seconds of the coordinator's clock).

    ``key`` is the holder's public key; empty if the coordinator has no keys.
    """

    place: str
    epoch: int
    holder: bytes
    instance: str
    heard: float
    expires: float
    endpoint: str
    released: bool = False
    key: str = ""


class LeaseTable:
    """The leases on a fixed set of places (sub-tasks, or the evaluator role).

    Args:
        places: what can be leased.
        duration: seconds for which a heartbeat renews a lease.
    """

    def __init__(self, places: Iterable[str], duration: float) -> None:
        self.places = tuple(places)
        self.duration = duration
        self._leases: dict[str, Lease] = {}
        self._epochs: dict[str, int] = dict.fromkeys(self.places, 0)

    def epochs(self) -> dict[str, int]:
        """The newest epoch of every place; 0 if it was never held."""
        return dict(self._epochs)

    def raise_epochs(self, epochs: Mapping[str, int]) -> None:
        """Continue above these epochs, which the coordinator granted before a restart."""
        for place in self.places:
            self._epochs[place] = max(self._epochs[place], epochs.get(place, 0))

    def get(self, place: str) -> Lease | None:
        """The newest lease on a place, live or not."""
        return self._leases.get(place)

    def live(self, place: str, now: float) -> bool:
        """Whether the place is held now."""
        lease = self._leases.get(place)
        return lease is not None and lease.expires > now

    def next_free(self, now: float) -> str | None:
        """The first place without a live lease, preferring those never held."""
        free = [place for place in self.places if not self.live(place, now)]
        return min(free, key=lambda place: (place in self._leases, self.places.index(place)), default=None)

    def held_before_by(self, instance: str, key: str, holder: bytes, now: float) -> str | None:
        """The place this instance holds over an earlier connection."""
        own = (lease for lease in self.holders(now) if (lease.instance, lease.key) == (instance, key))
        return next((lease.place for lease in own if lease.holder != holder), None)

    def claim(self, place: str, holder: bytes, instance: str, endpoint: str, now: float, key: str = "") -> Lease | None:
        """Lease a place in a new epoch; None while another instance's lease is live.

        With keys, an instance is identified by its name and its key.
        """
        old = self._leases.get(place)
        if old is not None and old.expires > now and (old.instance, old.key) != (instance, key):
            return None
        self._epochs[place] += 1
        lease = Lease(place, self._epochs[place], holder, instance, now, now + self.duration, endpoint, key=key)
        self._leases[place] = lease
        return lease

    def renew(self, place: str, epoch: int, holder: bytes, now: float) -> bool:
        """Renew a lease; False if its epoch or holder is not the newest."""
        lease = self._leases.get(place)
        if lease is None or lease.epoch != epoch or lease.holder != holder:
            return False
        self._leases[place] = replace(lease, heard=now, expires=now + self.duration, released=False)
        return True

    def release(self, place: str, epoch: int, holder: bytes) -> bool:
        """Release a lease; False if it was not the sender's."""
        lease = self._leases.get(place)
        if lease is None or lease.epoch != epoch or lease.holder != holder:
            return False
        self._leases[place] = replace(lease, expires=lease.heard, released=True)
        return True

    def end(self, place: str) -> None:
        """End a lease now, regardless of its holder."""
        lease = self._leases[place]
        self._leases[place] = replace(lease, expires=lease.heard, released=True)

    def holders(self, now: float) -> list[Lease]:
        """All live leases."""
        return [lease for lease in self._leases.values() if lease.expires > now]

    def all(self) -> list[Lease]:
        """The newest lease of every place that ever had one."""
        return list(self._leases.values())
