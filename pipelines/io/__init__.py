"""Files of a result folder: trajectories, point clouds, timings, metrics."""
