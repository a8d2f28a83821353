"""The station: everything between the commanded wrench and the estimated state."""
