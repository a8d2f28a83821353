"""The state estimator: an error-state Kalman filter as pure functions, and its systems."""
