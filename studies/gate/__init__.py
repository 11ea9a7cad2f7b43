"""The gate's error rates, measured: false alarms, a rise of one estimator's error, and planted faults."""
