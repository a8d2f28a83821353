"""The simulated vehicle: plant, disturbances, sensors, thruster allocation and its limits."""
