"""The station: everything between a controller's wrench and the state it is told."""
