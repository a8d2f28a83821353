"""Laws of the disturbance: level, colour, heavy tails, waves, varying currents."""
