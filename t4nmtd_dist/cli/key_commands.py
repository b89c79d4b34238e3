"""The subcommands of ``t4nmtd keys``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
Name = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]


@dataclass(frozen=True)
class New:
    """Make the coordinator's keys, with a client of its own for commands on the same machine."""

    folder: Folder
    """Folder to make; it becomes --keys of the coordinator, and of other commands on its machine."""
    clients: int = 0
    """How many further clients; each gets a folder DIR/clients/NAME to be carried to its machine."""
    coordinator: str | None = None
    """Make a client's keys instead, which trust the coordinator of this public key; then `keys add` it there."""
    name: str = "client"
    """With --coordinator: the client's name."""

    def run(self) -> int:
        """Make keys."""
        from t4nmtd_dist.wire.auth.key_folders import make_client_folder, make_coordinator_folder
        from t4nmtd_dist.wire.auth.keys import load_coordinator

        if self.coordinator is not None:
            pair = make_client_folder(self.folder, self.name, self.coordinator)
            print(f"{self.folder}: a client's keys. On the coordinator's machine, let it in:")
            print(f"  t4nmtd keys add DIR {pair.name} --public '{pair.public}'")
            return 0
        made = make_coordinator_folder(self.folder, self.clients)
        print(f"{self.folder}: the coordinator's keys, and those of a client on this machine (--keys {self.folder})")
        for folder in made:
            print(f"{folder}: carry it to the client's machine over a protected channel, and delete it here")
        print(f"the coordinator's public key: {load_coordinator(self.folder).public}")
        return 0


@dataclass(frozen=True)
class Add:
    """Let a further client in; a running coordinator notices at once."""

    folder: Folder
    """The coordinator's folder."""
    name: Name
    """What to call the client."""
    public: str | None = None
    """Its public key, if it has made its keys itself; else they are made in DIR/clients/NAME."""

    def run(self) -> int:
        """Add."""
        from t4nmtd_dist.wire.auth.key_folders import add_client, allow

        if self.public is not None:
            allow(self.folder, self.name, self.public)
            print(f"{self.name} may connect")
            return 0
        made = add_client(self.folder, self.name)
        print(f"{made}: carry it to {self.name}'s machine over a protected channel, and delete it here")
        return 0


@dataclass(frozen=True)
class Revoke:
    """Take a client off the list; a running coordinator ends its connection and leases within a second."""

    folder: Folder
    """The coordinator's folder."""
    name: Name
    """Which client."""

    def run(self) -> int:
        """Revoke."""
        from t4nmtd_dist.wire.auth.key_folders import revoke

        revoke(self.folder, self.name)
        print(f"{self.name} may not connect any more")
        return 0


@dataclass(frozen=True)
class List:
    """Show the clients that may connect, with their public keys."""

    folder: Folder
    """The coordinator's folder."""

    def run(self) -> int:
        """List."""
        from t4nmtd_dist.wire.auth.key_folders import listed_clients
        from t4nmtd_dist.wire.auth.keys import read_public

        coordinator = read_public(self.folder / "coordinator.public")[1]
        for name, public in {"coordinator": coordinator, **listed_clients(self.folder)}.items():
            print(f"{public}  {name}")
        return 0


@dataclass(frozen=True)
class Keys:
    """Keys that let other machines in, and no strangers (docs/security.md)."""

    action: tyro.conf.OmitSubcommandPrefixes[New | Add | Revoke | List]
    """What to do."""

    def run(self) -> int:
        """Run the chosen subcommand."""
        return self.action.run()
