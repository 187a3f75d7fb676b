"""The benchmark: a list of sequences run several times, its tables, and what others have published.

Owns bench.json and bench.md. The errors are those of `pipelines.evaluation`, the figures `viz`'s.
"""
