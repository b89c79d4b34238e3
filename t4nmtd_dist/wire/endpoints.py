"""Default endpoints and their validation, without heavy imports."""

from __future__ import annotations

from t4nmtd_dist.core.errors import ConfigError

DEFAULT_CONTROL = "tcp://127.0.0.1:5570"
DEFAULT_STATE = "tcp://127.0.0.1:5571"
CONTROL_PORT, STATE_PORT = 5570, 5571


def check_endpoint(endpoint: str) -> None:
    """Reject anything but ``tcp://HOST:PORT``.

    Raises:
        ConfigError: with the expected form.
    """
    scheme, _, rest = endpoint.partition("://")
    host, _, port = rest.rpartition(":")
    port_fits = port == "*" or (port.isascii() and port.isdigit() and len(port) <= 5 and int(port) < 65536)
    name = host[1:-1].replace(":", "0") if host[:1] + host[-1:] == "[]" else host
    if scheme != "tcp" or not port_fits or not name or not name.isprintable() or set(name) & set(":[]/ "):
        raise ConfigError(f"endpoint {endpoint!r}: expected tcp://HOST:PORT, for instance {DEFAULT_CONTROL}")


def complete_endpoint(text: str, port: int) -> str:
    """Complete ``tcp://HOST:PORT``, ``HOST:PORT`` or ``HOST`` (with the default port) to an endpoint.

    Raises:
        ConfigError: if the text has none of these forms.
    """
    endpoint = text if "://" in text else f"tcp://{text}"
    if ":" not in endpoint.partition("://")[2]:
        endpoint += f":{port}"
    check_endpoint(endpoint)
    return endpoint
