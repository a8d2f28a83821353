"""The check of the estimator: consistency of its covariance, and its response to sensor faults."""
