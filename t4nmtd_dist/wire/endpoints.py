"""Endpoints by default, and what an endpoint must look like; imports nothing heavy, for the command lines."""

from __future__ import annotations

from t4nmtd_dist.core.errors import ConfigError

DEFAULT_CONTROL = "tcp://127.0.0.1:5570"
DEFAULT_STATE = "tcp://127.0.0.1:5571"
CONTROL_PORT, STATE_PORT = 5570, 5571


def check_endpoint(endpoint: str) -> None:
    """Refuse what is not ``tcp://HOST:PORT``.

    Raises:
        ConfigError: with the form that was expected.
    """
    scheme, _, rest = endpoint.partition("://")
    host, _, port = rest.rpartition(":")
    port_fits = port == "*" or (port.isascii() and port.isdigit() and len(port) <= 5 and int(port) < 65536)
    name = host[1:-1].replace(":", "0") if host[:1] + host[-1:] == "[]" else host
    if scheme != "tcp" or not port_fits or not name or not name.isprintable() or set(name) & set(":[]/ "):
        raise ConfigError(f"endpoint {endpoint!r}: expected tcp://HOST:PORT, for instance {DEFAULT_CONTROL}")


def complete_endpoint(text: str, port: int) -> str:
    """``tcp://HOST:PORT`` from that, from ``HOST:PORT``, or from ``HOST`` alone with the usual port.

    Raises:
        ConfigError: if it can be none of these.
    """
    endpoint = text if "://" in text else f"tcp://{text}"
    if ":" not in endpoint.partition("://")[2]:
        endpoint += f":{port}"
    check_endpoint(endpoint)
    return endpoint
