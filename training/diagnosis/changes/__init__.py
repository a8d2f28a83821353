"""Causes that act in a part of the data, or change in the course of it."""
