"""Diagrams in one compiled loop: what systems compute, as pure functions."""
