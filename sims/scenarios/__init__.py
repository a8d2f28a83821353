"""Scenarios: the complete settings of a run in one YAML file each; the shipped scenarios."""
