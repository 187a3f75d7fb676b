"""Sequences that the project renders itself, with exact truth; see `SimulatedSequence`."""

from pipelines.datasets.simulated.sequence import SimulatedSequence

__all__ = ["SimulatedSequence"]
