"""Messages between processes: types, framing and sockets (docs/protocol.md)."""
