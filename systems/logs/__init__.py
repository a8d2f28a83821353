"""Logs of vehicles (.tlog, .BIN) and other data to recordings: all importers."""
