"""Making key folders, and the list of clients that may connect: what ``t4nmtd keys`` does."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from t4nmtd_dist.core.errors import KeyFileError
from t4nmtd_dist.wire.auth.keys import (
    ALLOWED,
    CLIENT,
    CLIENTS,
    COORDINATOR,
    OWN_CLIENT,
    PUBLIC_KEY,
    KeyPair,
    make_private_folder,
    new_pair,
    read_public,
    write_public,
    write_secret,
)


def make_coordinator_folder(folder: Path, clients: int = 0) -> list[Path]:
    """A coordinator's keys with a client of its own, and the folders of further clients.

    Args:
        folder: where; made with access for its owner only.
        clients: how many further clients, named client1, client2 and so on.

    Returns:
        The further clients' folders.

    Raises:
        KeyFileError: if the folder holds keys already or cannot be written.
    """
    _make_private(folder)
    pair = new_pair(COORDINATOR)
    write_secret(folder / f"{COORDINATOR}.secret", pair)
    write_public(folder / f"{COORDINATOR}.public", pair.name, pair.public)
    own = new_pair(OWN_CLIENT)
    write_secret(folder / f"{CLIENT}.secret", own)
    allow(folder, own.name, own.public)
    return [add_client(folder, f"client{number}") for number in range(1, clients + 1)]


def make_client_folder(folder: Path, name: str, coordinator: str) -> KeyPair:
    """A client's keys, made where they are used; their public half then goes to the coordinator's list.

    Args:
        folder: where.
        name: the client's name.
        coordinator: the coordinator's public key.

    Raises:
        KeyFileError: if the folder holds keys already or cannot be written, or a key or name is malformed.
    """
    if not PUBLIC_KEY.fullmatch(coordinator):
        raise KeyFileError(f"{coordinator!r} is no public key: expected 40 characters of Z85")
    pair = new_pair(name)
    _make_private(folder)
    write_secret(folder / f"{CLIENT}.secret", pair)
    write_public(folder / f"{COORDINATOR}.public", COORDINATOR, coordinator)
    return pair


def add_client(folder: Path, name: str) -> Path:
    """A further client of a coordinator; the folder to carry to the client's machine.

    Raises:
        KeyFileError: if there is a client of that name, or the folder holds no coordinator's keys.
    """
    _, coordinator = read_public(folder / f"{COORDINATOR}.public")
    _check_unlisted(folder, name, "")
    made = folder / CLIENTS / name
    _make_private(folder / CLIENTS)
    pair = make_client_folder(made, name, coordinator)
    allow(folder, name, pair.public)
    return made


def allow(folder: Path, name: str, public: str) -> None:
    """Put a client's public key on the list.

    Raises:
        KeyFileError: if the name or key is on it already or malformed, or the list cannot be written.
    """
    if not PUBLIC_KEY.fullmatch(public):
        raise KeyFileError(f"{public!r} is no public key: expected 40 characters of Z85")
    new_pair(name)  # checks the name
    _check_unlisted(folder, name, public)
    write_public(folder / ALLOWED / f"{name}.public", name, public)


def _check_unlisted(folder: Path, name: str, public: str) -> None:
    for listed, key in listed_clients(folder).items():
        if name == listed or public == key:
            raise KeyFileError(f"{folder / ALLOWED} lists {listed} already, with key {key}; revoke it first")


def revoke(folder: Path, name: str) -> None:
    """Take a client off the list; a running coordinator notices within a second.

    Raises:
        KeyFileError: if it is not on the list.
    """
    path = folder / ALLOWED / f"{name}.public"
    if name not in listed_clients(folder):
        raise KeyFileError(f"no client {name!r} in {folder / ALLOWED}; `t4nmtd keys list {folder}` shows all")
    try:
        path.unlink()
    except OSError as error:
        raise KeyFileError(f"cannot delete {path}: {error.strerror}") from None


def listed_clients(folder: Path) -> Mapping[str, str]:
    """Public keys on the list by name.

    Raises:
        KeyFileError: if a file of the list is malformed.
    """
    paths = sorted((folder / ALLOWED).glob("*.public"))
    return {path.stem: read_public(path)[1] for path in paths}


def _make_private(folder: Path) -> None:
    try:
        if any(folder.glob("*.secret")):
            raise KeyFileError(f"{folder} holds keys already; `t4nmtd keys add {folder} NAME` adds a client")
        make_private_folder(folder)
    except OSError as error:
        raise KeyFileError(f"cannot make the folder {folder}: {error.strerror}") from None
