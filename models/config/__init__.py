"""Typed YAML and the checks that configurations make of themselves."""
