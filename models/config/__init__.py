"""Typed YAML and checks of configurations."""
