"""One-step predictions, their innovations, noise and sensitivities to effects."""
