"""What a connection that can't be opened is told: the reason, and the remedy of its kind."""

import errno
import socket

LISTENING = ("tcpin", "udpin")
"""Kinds of connections that wait for the other side."""
_REMEDIES = {
    "tcp": "check that the vehicle or its router listens there, and the address",
    "tcpin": "another program may use the port; close it or name another port",
    "udpin": "another program may use the port; close it or name another port",
    "udpout": "check the address",
    "serial": "check the device's name, that it is plugged in and that you may open it",
}


def refusal(kind: str, address: str, number: int, error: Exception) -> str:
    """Reason and remedy of a connection that `error` kept from being opened."""
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    remedy = _REMEDIES[kind]
    if kind in LISTENING and no_local(error):
        reason = f"{address} is no address of this computer"
        remedy = f"give {kind}:0.0.0.0:{number}"
    elif kind in LISTENING and isinstance(error, PermissionError):
        remedy = "name a port of 1024 or more"
    return f"{reason}; {remedy}"


def no_local(error: Exception) -> bool:
    """Whether a socket can't listen as its host is no address, or not one of this computer."""
    number = getattr(error, "errno", None)  # create_server makes a plain OSError of a gaierror
    names = (socket.EAI_NONAME, socket.EAI_NODATA, socket.EAI_AGAIN)
    unreadable = isinstance(error, socket.gaierror | UnicodeError)
    return unreadable or number in (errno.EADDRNOTAVAIL, *names)
