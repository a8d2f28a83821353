"""Diagrams as one compiled loop: systems' events and outputs as pure functions."""
