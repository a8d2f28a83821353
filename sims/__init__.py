"""Scenarios, studies, reports and the command line."""
