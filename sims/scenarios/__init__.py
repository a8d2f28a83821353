"""Scenarios: all that decides a run, in one YAML file each; those that are shipped."""
