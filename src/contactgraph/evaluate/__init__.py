"""Running episodes, and the metrics over what was recorded."""
