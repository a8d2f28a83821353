"""Vehicles in numbers: the presets that are shipped, their thrusters' curves."""
