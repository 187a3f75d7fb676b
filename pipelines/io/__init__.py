"""Files of a result folder: settings, trajectories, point clouds, timings, metrics."""
