"""The sequences of a benchmark: the list that needs no download, and how one is opened.

Owns what differs from run to run of the same sequence. Runs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from pipelines.datasets import open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.errors import ConfigError

Progress = Callable[[int, int], None]
SIMULATED = "simulated"


@dataclass(frozen=True, slots=True)
class BenchCase:
    """A sequence to run: its path or simulated:NAME.

    dataset: the layout, where it should not be guessed. degrade, provide: of simulated sequences
    alone, as `SimulatedSequence` takes them.
    """

    path: str
    dataset: str | None = None
    degrade: str | None = None
    provide: str | None = None

    def __post_init__(self) -> None:
        if (self.degrade or self.provide) and not self.is_simulated:
            raise ConfigError(
                f"--degrade and --provide alter the inputs of simulated sequences, and {self.path} "
                "is none: leave them out, or give simulated sequences alone"
            )

    @property
    def is_simulated(self) -> bool:
        named = self.path == SIMULATED or self.path.startswith(f"{SIMULATED}:")
        return named or self.dataset == SIMULATED

    @property
    def is_noisy(self) -> bool:
        """Whether the inputs of one run differ from those of another, by their noise."""
        return self.is_simulated and self.degrade not in (None, "", "none")

    @property
    def label(self) -> str:
        """The name until the sequence is open, and where it cannot be opened."""
        words = self.path.removeprefix(f"{SIMULATED}:").rstrip("/")
        name = words.rpartition("/")[2] or self.path
        return name + ("-degraded" if self.is_noisy else "")

    def open(self, seed: int, progress: Progress = lambda done, total: None) -> Sequence:
        """The sequence of run `seed`. progress: called while a simulated one is rendered."""
        options: dict[str, Any] = {}
        if self.is_simulated:
            options["progress"] = progress
            options |= {"degrade": self.degrade} if self.degrade else {}
            options |= {"provide": self.provide} if self.provide else {}
            options |= {"noise_seed": seed} if self.is_noisy else {}
        return open_sequence(self.path, self.dataset, **options)

    def discard(self, sequence: Sequence, seed: int) -> None:
        """Remove the inputs that were made for run `seed` alone; those of run 0 others use too."""
        if self.is_noisy and seed > 0:
            from pipelines.datasets.simulated.cache import forget

            forget(sequence.root)


# Small and large pictures, stereo and RGB-D, exact and worn inputs; rendered here at first use.
DEFAULT_CASES = (
    BenchCase("simulated:demo"),
    BenchCase("simulated:demo", degrade="all"),
    BenchCase("simulated:street", degrade="all"),
    BenchCase("simulated:room", degrade="all"),
)


def labels_of(cases: Iterable[BenchCase]) -> list[str]:
    """A name a case, none twice."""
    labels: list[str] = []
    for case in cases:
        label, number = case.label, 1
        while label in labels:
            number += 1
            label = f"{case.label}-{number}"
        labels.append(label)
    return labels
