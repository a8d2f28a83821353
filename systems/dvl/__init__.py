"""Doppler velocity logs that are read directly: byte streams to readings."""
