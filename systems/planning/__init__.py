"""Plans: MPPI, references, obstacles, and the vectors that carry a plan."""
