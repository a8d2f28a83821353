"""Data to train on: windows, groups, simulated maneuvers, provenance."""
