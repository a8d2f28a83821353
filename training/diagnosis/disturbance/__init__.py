"""Laws of the disturbance: level, memory, tails, waves, varying currents."""
