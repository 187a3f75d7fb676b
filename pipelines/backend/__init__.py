"""The back-end: graphs of poses and points, solved with gtsam, which is imported here alone."""
