"""Files on disk: atomic writes, ownership, locks, checks."""
