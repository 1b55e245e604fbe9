"""What the estimator of deploy/ is measured with: simulated robots and sensors, and reference filters."""
