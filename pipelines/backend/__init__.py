"""The back-end: what works beside tracking, on keyframes instead of frames.

Owns the recognition of places seen before, and everything that moves keyframes and points after
they were tracked. Does not own tracking, nor the map that tracking reads.
"""
