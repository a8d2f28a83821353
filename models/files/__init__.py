"""Files on disk: whole or absent, owned, locked, checked."""
