"""Training data: windows, groups, simulated maneuvers, provenance."""
