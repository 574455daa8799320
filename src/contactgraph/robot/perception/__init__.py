"""Where tagged objects are: from camera frames to positions, velocities and how sure they are."""
