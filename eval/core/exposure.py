"""Which addresses other machines can reach."""

from __future__ import annotations

from ipaddress import ip_address


def is_loopback(host: str) -> bool:
    """Return whether a host's address or name is of this machine alone; other names than "localhost" are not asked."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
