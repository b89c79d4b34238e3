"""CURVE keys on disk, and the list of allowed clients (docs/security.md).

``t4nmtd keys new`` creates a folder with::

    coordinator.secret  coordinator.public     the coordinator's own pair
    client.secret                              a client's own pair, for commands on this machine
    allowed/NAME.public                        the list: one file for each client that may connect
    clients/NAME/                              a ``--keys`` folder to carry to another machine

A client's folder holds ``client.secret`` and ``coordinator.public``. Every file is TOML with ``format``, ``name`` and
``public``; ``.secret`` files also have ``secret``. Keys are 32 bytes as 40 characters of Z85.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import zmq

from t4nmtd_dist.core.errors import KeyFileError

FORMAT = "t4nmtd key 1"
COORDINATOR, CLIENT = "coordinator", "client"
ALLOWED, CLIENTS = "allowed", "clients"
OWN_CLIENT = "local"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
PUBLIC_KEY = re.compile(r"[0-9A-Za-z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")


@dataclass(frozen=True)
class KeyPair:
    """A named CURVE key pair in Z85; printing it does not show the secret half."""

    name: str
    public: str
    secret: str = field(repr=False)


@dataclass(frozen=True)
class ClientKeys:
    """A client's own pair and its server's public key.

    Attributes:
        own: the client's pair.
        server: the only accepted server key.
    """

    own: KeyPair
    server: str

    def to(self, server: str) -> ClientKeys:
        """The same client's keys for another server."""
        return ClientKeys(self.own, server)


def new_pair(name: str) -> KeyPair:
    """Generate a pair.

    Raises:
        KeyFileError: if the name is malformed.
    """
    if not NAME.fullmatch(name):
        raise KeyFileError(f"{name!r} cannot name a key: expected letters, digits, dots, hyphens and underscores")
    while True:
        public, secret = zmq.curve_keypair()
        if public[:1].isalnum():  # so that no command line parses it as an option
            return KeyPair(name, public.decode(), secret.decode())


def load_client(folder: Path) -> ClientKeys:
    """A client's keys from its ``--keys`` folder.

    Raises:
        KeyFileError: if a file is missing or malformed, or others can read the secret one.
    """
    return ClientKeys(read_secret(folder / f"{CLIENT}.secret"), read_public(folder / f"{COORDINATOR}.public")[1])


def load_coordinator(folder: Path) -> KeyPair:
    """The coordinator's pair from its ``--keys`` folder.

    Raises:
        KeyFileError: see ``read_secret``.
    """
    return read_secret(folder / f"{COORDINATOR}.secret")


def read_secret(path: Path) -> KeyPair:
    """A pair from a ``.secret`` file.

    Raises:
        KeyFileError: if it is missing, malformed, or readable by others.
    """
    values = _values(path)
    if stat.S_IMODE(path.stat().st_mode) & 0o077:
        raise KeyFileError(f"{path} can be read by others than its owner; make new keys, or: chmod 600 {path}")
    secret = values.get("secret", "")
    try:
        public = zmq.curve_public(secret.encode()).decode()
    except (ValueError, zmq.ZMQError):
        public = ""
    if not public or public != values["public"]:
        raise KeyFileError(f"{path}: the secret key is damaged or does not belong to the public one; make new keys")
    return KeyPair(values["name"], public, secret)


def read_public(path: Path) -> tuple[str, str]:
    """Name and public key from a ``.public`` or ``.secret`` file.

    Raises:
        KeyFileError: if it is missing or malformed.
    """
    values = _values(path)
    return values["name"], values["public"]


def _values(path: Path) -> dict[str, str]:
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise KeyFileError(f"{path} is missing: expected a folder made by `t4nmtd keys new`; {_hint(path)}") from None
    except (OSError, ValueError) as error:
        raise KeyFileError(f"{path} is not a readable key file: {error}") from None
    fields = all(isinstance(values.get(key), str) for key in ("name", "public"))
    if values.get("format") != FORMAT or not fields or not PUBLIC_KEY.fullmatch(values["public"]):
        raise KeyFileError(f'{path}: expected format = "{FORMAT}", name and public (40 characters of Z85)')
    return {key: str(value) for key, value in values.items()}


def _hint(path: Path) -> str:
    if path.name == f"{COORDINATOR}.secret":
        return "the coordinator needs the folder that holds coordinator.secret, not a client's"
    return f"a client needs a folder such as DIR/{CLIENTS}/NAME, with client.secret and coordinator.public"


def make_private_folder(path: Path) -> None:
    """Create a folder for its owner only, or correct its permissions.

    Raises:
        OSError: if it cannot be created.
    """
    path.mkdir(parents=True, exist_ok=True, mode=0o700)
    path.chmod(0o700)


def write_secret(path: Path, pair: KeyPair) -> None:
    """Write a pair, readable by its owner only.

    Raises:
        KeyFileError: if the file exists or cannot be written.
    """
    head = "# Whoever can read this file can take its owner's place. Never copy it over an unprotected channel.\n"
    _write(path, head + _lines(pair.name, pair.public) + f'secret = "{pair.secret}"\n', 0o600)


def write_public(path: Path, name: str, public: str) -> None:
    """Write a public key.

    Raises:
        KeyFileError: if the file exists or cannot be written.
    """
    _write(path, _lines(name, public), 0o644)


def _lines(name: str, public: str) -> str:
    return f'format = "{FORMAT}"\nname = "{name}"\npublic = "{public}"\n'


def _write(path: Path, text: str, mode: int) -> None:
    """Write atomically with final permissions; never overwrite."""
    fresh = path.with_name(f".{path.name}.new")
    try:
        if not path.parent.is_dir():
            make_private_folder(path.parent)
        fresh.unlink(missing_ok=True)
        with open(fresh, "x", encoding="utf-8", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            os.fchmod(file.fileno(), mode)  # the umask may have cleared some bits
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.link(fresh, path)
        fresh.unlink()
    except FileExistsError:
        fresh.unlink(missing_ok=True)
        raise KeyFileError(f"{path} exists already; choose another folder or name") from None
    except OSError as error:
        raise KeyFileError(f"cannot write {path}: {error.strerror}") from None
