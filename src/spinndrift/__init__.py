"""Learned stochastic dynamics and control for underwater vehicles, composed as Drake diagrams."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("spinndrift")
except PackageNotFoundError:  # a source tree on the path, never installed
    __version__ = "0+unknown"
