"""The back-end: what works beside tracking, on keyframes and on what whole runs saw.

Owns the recognition of places seen before, and everything that moves poses and points after they
were tracked; gtsam is imported here alone. Does not own tracking, nor the map that tracking reads.
"""
