"""Whether the estimator's covariance is right, and what it makes of failing sensors."""
