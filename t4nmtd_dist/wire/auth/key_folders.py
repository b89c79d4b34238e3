"""Creates key folders and edits the allow list, for ``t4nmtd keys``."""

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
    """Create keys for a coordinator, a local client and further clients.

    Args:
        folder: created with access for its owner only.
        clients: number of further clients, named client1, client2 and so on.

    Returns:
        The further clients' folders.

    Raises:
        KeyFileError: if the folder already holds keys or cannot be written.
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
    """Create a client's keys; the coordinator's list still needs their public half.

    Args:
        folder: path.
        name: the client's name.
        coordinator: the coordinator's public key.

    Raises:
        KeyFileError: if the folder already holds keys or cannot be written, or a key or name is malformed.
    """
    if not PUBLIC_KEY.fullmatch(coordinator):
        raise KeyFileError(f"{coordinator!r} is no public key: expected 40 characters of Z85")
    pair = new_pair(name)
    _make_private(folder)
    write_secret(folder / f"{CLIENT}.secret", pair)
    write_public(folder / f"{COORDINATOR}.public", COORDINATOR, coordinator)
    return pair


def add_client(folder: Path, name: str) -> Path:
    """Add a client to a coordinator; returns the folder to carry to its machine.

    Raises:
        KeyFileError: if the client exists, or the folder holds no coordinator's keys.
    """
    _, coordinator = read_public(folder / f"{COORDINATOR}.public")
    _check_unlisted(folder, name, "")
    made = folder / CLIENTS / name
    _make_private(folder / CLIENTS)
    pair = make_client_folder(made, name, coordinator)
    allow(folder, name, pair.public)
    return made


def allow(folder: Path, name: str, public: str) -> None:
    """Add a client's public key to the list.

    Raises:
        KeyFileError: if the name or key is malformed or already listed, or the list cannot be written.
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
    """Remove a client from the list; a running coordinator notices within a second.

    Raises:
        KeyFileError: if the client is not on the list.
    """
    path = folder / ALLOWED / f"{name}.public"
    if name not in listed_clients(folder):
        raise KeyFileError(f"no client {name!r} in {folder / ALLOWED}; `t4nmtd keys list {folder}` shows all")
    try:
        path.unlink()
    except OSError as error:
        raise KeyFileError(f"cannot delete {path}: {error.strerror}") from None


def listed_clients(folder: Path) -> Mapping[str, str]:
    """The listed public keys by client name.

    Raises:
        KeyFileError: if a file is malformed.
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
